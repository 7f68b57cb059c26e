"""Ensemble smoothers: correct the members of an earlier time by later readings.

Both need members that are paired in time: member i at t + 1 is the forecast of member i at t. An update that breaks
the pairing, such as a random rotation of the members after each analysis, makes them invalid.

Sources: Evensen & van Leeuwen 2000 (the ensemble Kalman smoother, an analysis of past members); Raanes
2016, Q. J. R. Meteorol. Soc. 142 (the ensemble Rauch-Tung-Striebel smoother, and how the two compare).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_ensemble, check_number, check_shape
from torch_denkf.functional.linalg import semidefinite_solve, solve
from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.moments import ensemble_anomalies
from torch_denkf.functional.smoothing.backward import run_backward


def enrts_step(ensemble: Tensor, forecast: Tensor, smoothed: Tensor, *, damping: float = 1.0) -> Tensor:
    """Smooths one step back in time: the members of t from those of t + 1.

    X + (X_s − X_f) A_f⁺ A, with A and A_f the anomalies at t and of the forecast: the gain of
    :func:`~torch_denkf.functional.smoothing.rts.rts_step` from sample covariances. The smaller of the two possible
    systems is solved, S x S or E x E.

    Args:
        ensemble: X, the filter's belief at t, ``[*B, E, S]``.
        forecast: X_f of t + 1, the forecasts of the same members, ``[*B, E, S]``.
        smoothed: X_s of t + 1, ``[*B, E, S]``.
        damping: factor of the gain. If the filter inflates its members by a factor r, the gains carry the inflation
            back, r times more in each step, in unobserved directions: damping below 1 / r keeps a long backward pass
            stable (``DeCorr`` in DAPPER).

    Returns:
        The smoothed members of t, ``[*B, E, S]``.

    Raises:
        ValueError: if the shapes do not fit, or ``damping`` is not in (0, 1].

    Examples:
        Members that double in each step, and are 1 larger at t + 1 after smoothing:

        >>> import torch
        >>> members = torch.tensor([[-1.0], [1.0]])
        >>> enrts_step(members, 2 * members, 2 * members + 1).flatten()
        tensor([-0.5000,  1.5000])
    """
    check_ensemble("ensemble", ensemble, min_size=2)
    for name, value in (("forecast", forecast), ("smoothed", smoothed)):
        check_shape(name, value, ensemble.shape, "[*B, E, S]")
    check_number("damping", damping, above=0, most=1, cure="It is a factor of the gain")
    size, dim = ensemble.shape[-2:]
    anomalies, forecast_anomalies = ensemble_anomalies(ensemble), ensemble_anomalies(forecast)
    # If all members are equal up to rounding, their anomalies have no information.
    spread = forecast_anomalies.square().mean(-2, keepdim=True).detach().sqrt()
    alike = spread <= 4 * torch.finfo(forecast.dtype).eps * forecast.abs().amax(-2, keepdim=True).detach()
    forecast_anomalies = torch.where(alike, 0, forecast_anomalies)
    shift = damping * (smoothed - forecast)
    if dim < size:
        cross = forecast_anomalies.mT @ anomalies
        return ensemble + shift @ semidefinite_solve(forecast_anomalies.mT @ forecast_anomalies, cross)
    # Scaled by the spread, so that units do not matter. The anomalies sum to zero: the eigenvalue of the vector of ones
    # can be chosen, and at the mean of the diagonal the system keeps its digits.
    scale = torch.where(alike, 0, 1 / torch.where(alike, 1, spread))
    scaled = forecast_anomalies * scale
    gram = scaled @ scaled.mT
    level = gram.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    level = torch.where(level > 0, level, 1)  # without any spread: no correction, and no singular system
    ridge = 10 * size * torch.finfo(gram.dtype).eps
    identity = torch.eye(size, dtype=gram.dtype, device=gram.device)
    weights = solve(gram + level * (1 / size + ridge * identity), scaled @ (shift * scale).mT)
    return ensemble + weights.mT @ anomalies


def enrts_smooth(
    ensemble: Tensor,
    forecast: Tensor,
    *,
    follows: Tensor | None = None,
    lag: int | None = None,
    damping: float = 1.0,
    space: Space | None = None,
) -> Tensor:
    """Smooths the ensembles of a whole sequence.

    Args:
        ensemble: the filter's beliefs, ``[*B, T, E, S]``.
        forecast: forecasts of the members before, for each time, ``[*B, T, E, S]``.
        follows: boolean ``[*B, T]``; False if an element is not one step on from the one before. None: all are.
        lag: number of later readings: the belief of t given those up to t + lag. None: all of the sequence.
        damping: see :func:`enrts_step`.
        space: space of the state: members are points, and :func:`enrts_step` runs on the tangents at the mean of
            each time. ``None`` for plain numbers.

    Returns:
        The smoothed ensembles, ``[*B, T, E, S]``.

    Raises:
        ValueError: if the shapes do not fit, or ``lag`` is negative.

    Examples:
        >>> import torch
        >>> members = torch.tensor([[-1.0], [1.0]])
        >>> beliefs = torch.stack([members, members + 1])
        >>> enrts_smooth(beliefs, torch.stack([members, members]))[0].mean().round(decimals=4)
        tensor(1.)
    """

    def step(own, link, later):
        values = (*own, *link, *later)
        if space is None:
            return (enrts_step(*values, damping=damping),)
        center, expected = (space.mean(points).unsqueeze(-2) for points in values[:2])
        tangents = map(space.minus, values, (center, expected, expected))
        return (space.plus(center, enrts_step(*tangents, damping=damping)),)

    check_ensemble("ensemble", ensemble, min_size=2)
    return run_backward(step, ensemble.ndim - 3, (ensemble,), (forecast,), follows=follows, lag=lag)[0]
