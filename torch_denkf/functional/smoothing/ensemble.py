"""Ensemble smoothers: the members of an earlier time, moved by what later readings said.

Both use that members are paired in time: member i at t + 1 is the forecast of member i at t. An update that mixes the
pairing up, such as a random rotation of the members after each analysis, takes their ground away.

Sources: Evensen & van Leeuwen 2000 (the ensemble Kalman smoother, which is an analysis of the past's members); Raanes
2016, Q. J. R. Meteorol. Soc. 142 (the ensemble Rauch-Tung-Striebel smoother, and how the two compare).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_ensemble, check_number, check_shape
from torch_denkf.functional.linalg import semidefinite_solve, solve
from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.moments import ensemble_anomalies
from torch_denkf.functional.smoothing.rts import check_lag


def enrts_step(ensemble: Tensor, forecast: Tensor, smoothed: Tensor, *, damping: float = 1.0) -> Tensor:
    """One step back in time: the smoothed members of t from those of t + 1.

    X + (X_s − X_f) A_f⁺ A, with A and A_f the anomalies at t and of the forecast: the gain of
    :func:`~torch_denkf.functional.smoothing.rts.rts_step` from sample covariances. The smaller of the two possible
    systems is solved, S x S or E x E.

    Args:
        ensemble: X, the filter's belief at t, ``[*B, E, S]``.
        forecast: X_f of t + 1, the same members one step on, ``[*B, E, S]``.
        smoothed: X_s of t + 1, ``[*B, E, S]``.
        damping: factor on the gain. Where the filter inflates its members by a factor r, the gains carry the inflation
            back, r times more in each step, in directions that no reading holds: damping below 1 / r keeps a long way
            back stable (``DeCorr`` in DAPPER).

    Returns:
        The smoothed members of t, ``[*B, E, S]``.

    Raises:
        ValueError: if the shapes do not fit, or ``damping`` is not in (0, 1].

    Examples:
        Members that double in each step, and at t + 1 turn out to be 1 larger:

        >>> import torch
        >>> members = torch.tensor([[-1.0], [1.0]])
        >>> enrts_step(members, 2 * members, 2 * members + 1).flatten()
        tensor([-0.5000,  1.5000])
    """
    check_ensemble("ensemble", ensemble, min_size=2)
    for name, value in (("forecast", forecast), ("smoothed", smoothed)):
        check_shape(name, value, ensemble.shape, "[*B, E, S]")
    check_number("damping", damping, above=0, most=1, cure="It is a factor on the gain")
    size, dim = ensemble.shape[-2:]
    anomalies, forecast_anomalies = ensemble_anomalies(ensemble), ensemble_anomalies(forecast)
    # Where all members are alike, what they have beside their mean is rounding, and no direction to learn from.
    spread = forecast_anomalies.square().mean(-2, keepdim=True).detach().sqrt()
    alike = spread <= 4 * torch.finfo(forecast.dtype).eps * forecast.abs().amax(-2, keepdim=True).detach()
    forecast_anomalies = torch.where(alike, 0, forecast_anomalies)
    shift = damping * (smoothed - forecast)
    if dim < size:
        cross = forecast_anomalies.mT @ anomalies
        return ensemble + shift @ semidefinite_solve(forecast_anomalies.mT @ forecast_anomalies, cross)
    # In units of the spread, so that metres and milliradians count alike. The anomalies sum to zero: the eigenvalue of
    # the vector of ones is free, and at the mean of the diagonal the system keeps its digits.
    scale = torch.where(alike, 0, 1 / torch.where(alike, 1, spread))
    scaled = forecast_anomalies * scale
    gram = scaled @ scaled.mT
    level = gram.diagonal(dim1=-2, dim2=-1).mean(-1)[..., None, None]
    level = torch.where(level > 0, level, 1)  # members without any spread: nothing is learned, and nothing is singular
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
    """Smooth the ensembles of a whole sequence.

    Args:
        ensemble: the filter's beliefs, ``[*B, T, E, S]``.
        forecast: of each time, the members before it one step on, ``[*B, T, E, S]``.
        follows: boolean ``[*B, T]``; False where an element is not a step on from the one before it. None: all follow.
        lag: how many later readings count: the belief of t given those up to t + lag. None: all of the sequence.
        damping: see :func:`enrts_step`.
        space: in which the state lives: members are points, and :func:`enrts_step` is made with the tangents at the
            mean of each time. ``None`` for plain numbers.

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
    check_lag(lag)
    check_ensemble("ensemble", ensemble, min_size=2)
    check_shape("forecast", forecast, ensemble.shape, "[*B, T, E, S]")
    before, moved = ensemble[..., :-1, :, :], forecast[..., 1:, :, :]
    if follows is not None:
        check_shape("follows", follows, ensemble.shape[:-2], "[*B, T]")
        follows = follows[..., 1:]

    def back(index: slice | int, later: Tensor) -> Tensor:
        own, forecast = before[..., index, :, :], moved[..., index, :, :]
        if space is None:
            out = enrts_step(own, forecast, later, damping=damping)
        else:
            center, expected = (space.mean(points).unsqueeze(-2) for points in (own, forecast))
            tangents = [space.minus(points, expected) for points in (forecast, later)]
            out = space.plus(center, enrts_step(space.minus(own, center), *tangents, damping=damping))
        return out if follows is None else torch.where(follows[..., index][..., None, None], out, own)

    count = ensemble.shape[-3]
    if lag is None or lag >= count - 1:
        out = [ensemble[..., -1, :, :]]
        for t in range(count - 2, -1, -1):
            out.append(back(t, out[-1]))
        return torch.stack(out[::-1], -3)
    smoothed = ensemble
    for _ in range(lag):  # all times at once: each round takes in one more reading
        smoothed = torch.cat([back(slice(None), smoothed[..., 1:, :, :]), ensemble[..., -1:, :, :]], -3)
    return smoothed
