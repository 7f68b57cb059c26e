"""One number of a trained filter, chosen on held-out data; and the baseline that a filter has to beat."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence

import torch

__all__ = ["choose", "choose_for_coverage", "hold_last"]


@torch.no_grad()
def choose(candidates: Sequence[float], apply: Callable[[float], object], error: Callable[[], float]) -> float:
    """Tries values of a setting, keeps the best one: inflation, tempering, or a factor on the noise.

    Args:
        candidates: the values to try.
        apply: sets a value; it is called for each candidate, and at last with the best one.
        error: what the setting costs on held-out data, lower is better. Draw its random numbers from the same seed
            each time, so that candidates differ in nothing else.

    Returns:
        the best candidate, which is set; of equally good ones the first. An error of NaN never wins. A warning says
        where the best one is the last, as a grid that ends too early has it.

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


def choose_for_coverage(
    candidates: Sequence[float],
    apply: Callable[[float], object],
    coverage: Callable[[], torch.Tensor],
    level: float = 0.9,
) -> float:
    """Chooses the setting with which a filter's intervals hold the share of the truth that they state.

    Args:
        candidates: values to try, e.g. of an inflation.
        apply: sets a value, see :func:`choose`.
        coverage: the share of held-out true values inside intervals of ``level``: ``[]``, or ``[D]`` for each
            dimension (:func:`torch_denkf.metrics.interval_coverage`); their distances from ``level`` are added up.
        level: of the intervals, between 0 and 1.

    Returns:
        the best candidate, which is set.

    Raises:
        ValueError: if ``level`` is not between 0 and 1, if there are no candidates, or none has a finite coverage.

    Example:
        >>> from torch_denkf.metrics import interval_coverage
        >>> truth, variance = 2.0 * torch.randn(10_000, 1), torch.ones(10_000, 1)
        >>> coverage = lambda: interval_coverage(torch.zeros(10_000, 1), variance, truth, level=0.9)
        >>> choose_for_coverage([1.0, 4.0, 9.0], variance.fill_, coverage)
        4.0
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"level is a share between 0 and 1; got {level}.")
    return choose(candidates, apply, lambda: float((coverage() - level).abs().sum()))


def hold_last(
    values: torch.Tensor,
    observed: torch.Tensor,
    start: torch.Tensor,
    accept: Callable[[int, torch.Tensor], torch.Tensor] | None = None,
) -> torch.Tensor:
    """Holds the last reading where there is none: what a filter has to beat.

    Args:
        values: readings ``[*B, T, D]``.
        observed: which of them are there, ``[*B, T, 1]`` or ``[*B, T, D]``, bool.
        start: held before the first reading, ``[*B, D]``.
        accept: ``accept(t, held)`` says which readings at step t are usable, ``[*B, 1]`` or ``[*B, D]``, bool, given
            what is held ``[*B, D]``; all by default.

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
