"""The iterated ensemble Kalman smoother, which repeats a step from the smoothed previous state.

In a strongly non-linear step, one regression of readings on states is a poor approximation. Gauss-Newton steps in the
space of the members linearise again at the last estimate.

Source: Bocquet & Sakov 2012 and 2014 (Q. J. R. Meteorol. Soc. 140), the "transform" version with one step of lag, which
is the iterated ensemble Kalman filter of Sakov, Oliver & Bertino 2012.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torch_denkf._checks import check_ensemble, check_shape
from torch_denkf.functional.linalg import inverse_square_root, solve


def iterated_smoothing(
    ensemble: Tensor,
    predict: Callable[[Tensor], Tensor],
    observation: Tensor,
    noise: Tensor,
    *,
    observed: Tensor | None = None,
    iterations: int = 10,
) -> tuple[Tensor, Tensor]:
    """Conditions an ensemble on a reading after the next step.

    One iteration is the "etkf" analysis of the reading, applied to the members before the step.

    Args:
        ensemble: members before the step, ``[*B, E, S]`` with E >= 2.
        predict: forecasts members by one step (or several) and observes them: ``[*B, E, S]`` to ``[*B, E, O]``. It is
            called once per iteration, and must be deterministic.
        observation: the reading after the step, ``[*B, O]``.
        noise: variances R of the reading, ``[*B, O]``, positive.
        observed: boolean, ``[*B, 1]`` or ``[*B, O]``; False for missing components. None: everything is observed.
        iterations: number of Gauss-Newton iterations; 10 suffice for chaotic systems.

    Returns:
        The smoothed members ``[*B, E, S]``; and the predictions of the first iteration, ``[*B, E, O]``, for
        innovations. Members without an observation are returned unchanged.

    Raises:
        ValueError: if the shapes do not fit, or ``iterations`` is not positive.

    Examples:
        Two members at -1 and 1, and a reading of their cubes: 8, with little noise.

        >>> import torch
        >>> members = torch.tensor([[-1.0], [1.0]])
        >>> smoothed, _ = iterated_smoothing(members, lambda x: x**3, torch.tensor([8.0]), torch.tensor([0.01]))
        >>> smoothed.mean()
        tensor(1.9...)
    """
    check_ensemble("ensemble", ensemble, min_size=2)
    if iterations < 1:
        raise ValueError(f"iterations must be positive, got {iterations}.")
    batch, size = ensemble.shape[:-2], ensemble.shape[-2]
    dim = observation.shape[-1]
    check_shape("observation", observation, (*batch, dim), "[*B, O]")
    check_shape("noise", noise, (*batch, dim), "[*B, O]")
    if observed is not None:
        observation, noise = torch.where(observed, observation, 0), torch.where(observed, noise, 1)
    scale = (noise * (size - 1)).rsqrt().unsqueeze(-2)  # R^-1/2 / sqrt(E - 1)
    mean = ensemble.mean(-2, keepdim=True)
    anomalies = ensemble - mean
    identity = torch.eye(size, dtype=ensemble.dtype, device=ensemble.device)
    weights = torch.zeros_like(ensemble[..., :1])  # [*B, E, 1], of the mean
    transform = inverse = identity  # of the anomalies
    first: Tensor | None = None
    members = ensemble
    for _ in range(iterations):
        predicted = predict(members)
        first = predicted if first is None else first
        if observed is not None:
            predicted = torch.where(observed.unsqueeze(-2), predicted, 0)
        expected = predicted.mean(-2, keepdim=True)
        # The members' spread has shrunk with the last iterations: undone, it is the slope at the present mean.
        slopes = inverse @ ((predicted - expected) * scale)
        gram = slopes @ slopes.mT
        gradient = slopes @ ((observation.unsqueeze(-2) - expected) * scale).mT - weights
        weights = weights + solve(identity + gram, gradient)
        transform = inverse_square_root(gram)
        inverse = transform + gram @ transform
        members = mean + (weights.mT + transform) @ anomalies
    assert first is not None
    if observed is not None:
        members = torch.where(observed.any(-1)[..., None, None], members, ensemble)
    return members, first
