"""Calibration of a setting of a trained filter on held-out data; and zero-order hold as a baseline."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import torch

__all__ = ["choose", "hold_last"]


@torch.no_grad()
def choose(candidates: Sequence[float], apply: Callable[[float], object], error: Callable[[], float]) -> float:
    """Chooses the best value of a setting, such as inflation, tempering, or a factor on the noise.

    Args:
        candidates: the values to try.
        apply: sets a value; it is called for each candidate, and finally with the best one.
        error: returns the error on held-out data, lower is better, such as ``abs(coverage - 0.9)`` of
            :func:`~torch_denkf.metrics.interval_coverage`. Use the same seed each time, so that candidates differ in
            nothing else.

    Returns:
        the best candidate, which is set; the first of equally good ones. An error of NaN never wins. A warning says if
        the best one is the last, as the grid may end too early.

    Raises:
        ValueError: if there are no candidates, or none has a finite error.

    Example:
        >>> settings = {}
        >>> apply = lambda value: settings.update(inflation=value)
        >>> choose([0.5, 1.0, 2.0, 4.0], apply, error=lambda: (settings["inflation"] - 1.8) ** 2)
        2.0
        >>> settings
        {'inflation': 2.0}
    """
    errors = {}
    for value in candidates:
        apply(value)
        errors[value] = float(error())
    finite = {value: cost for value, cost in errors.items() if abs(cost) < float("inf")}
    if not finite:
        raise ValueError(f"none of the candidates has a finite error: {errors}; look for NaN in the held-out data.")
    best = min(finite, key=lambda value: finite[value])
    if len(candidates) > 2 and best == candidates[-1]:
        warnings.warn(f"the best of {list(candidates)} is the last; candidates beyond it may be better", stacklevel=3)
    apply(best)
    return best


def hold_last(
    values: torch.Tensor,
    observed: torch.Tensor,
    start: torch.Tensor,
    accept: Callable[[int, torch.Tensor], torch.Tensor] | None = None,
) -> torch.Tensor:
    """Repeats the last reading (zero-order hold), a baseline for a filter.

    Args:
        values: readings ``[*B, T, D]``.
        observed: observed mask, ``[*B, T, 1]`` or ``[*B, T, D]``, bool.
        start: value before the first reading, ``[*B, D]``.
        accept: ``accept(t, held)`` returns the mask of usable readings at step t, ``[*B, 1]`` or ``[*B, D]``, bool,
            given the held values ``[*B, D]``; all by default.

    Returns:
        the readings, with held ones in the gaps, ``[*B, T, D]``.

    Example:
        >>> values, observed = torch.tensor([[1.0], [2.0], [3.0]]), torch.tensor([[False], [True], [False]])
        >>> hold_last(values, observed, torch.zeros(1)).flatten().tolist()
        [0.0, 2.0, 2.0]
    """
    rows, held = [], start
    for step, (value, seen) in enumerate(zip(values.unbind(-2), observed.unbind(-2), strict=True)):
        held = torch.where(seen if accept is None else seen & accept(step, held), value, held)
        rows.append(held)
    return torch.stack(rows, -2)
