"""Smoothing of all times at once: an associative scan, of which the levels are log2 T and not the steps T.

The Rauch-Tung-Striebel step to t is affine: the smoothed mean is E m + g of that of t + 1, the covariance E P Eᵀ + L.
Two such steps are one, so pairs of steps are joined, and pairs of pairs. All work is in products of batches.

Source: Särkkä & García-Fernández 2021, IEEE T-AC 66.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_denkf.functional.smoothing.rts import smoothing_gain

__all__ = ["prefixes", "rts_in_time"]

_Elements = tuple[Tensor, ...]


def prefixes(join: Callable[[_Elements, _Elements], _Elements], elements: _Elements) -> _Elements:
    """Returns e_0, e_0 e_1, e_0 e_1 e_2, ... of an associative product.

    Args:
        join: the product of elements ``[N, ...]``, those before and those behind them.
        elements: ``[T, ...]``, in one tensor or several.

    Example:
        >>> prefixes(lambda one, other: (one[0] + other[0],), (torch.arange(5),))[0].tolist()
        [0, 1, 3, 6, 10]
    """
    count = len(elements[0])
    if count == 1:
        return elements
    odd = prefixes(join, join(tuple(e[: count - 1 : 2] for e in elements), tuple(e[1::2] for e in elements)))
    found = [torch.empty_like(e) for e in elements]
    for whole, first, second in zip(found, elements, odd, strict=True):
        whole[0], whole[1::2] = first[0], second
    if count > 2:
        later = tuple(e[2::2] for e in elements)
        for whole, value in zip(found, join(tuple(e[: len(later[0])] for e in odd), later), strict=True):
            whole[2::2] = value
    return tuple(found)


def rts_in_time(
    mean: Tensor,
    cov: Tensor,
    forecast_mean: Tensor,
    forecast_cov: Tensor,
    cross: Tensor,
    open_cov: Tensor | None = None,
    *,
    follows: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Does what :func:`~torch_denkf.functional.smoothing.rts.rts_smooth` does for plain numbers and all later readings.

    It takes three times the arithmetic of one step after the other, and one call for each level in the place of one for
    each step.

    Args:
        mean: of the filter's beliefs, ``[*B, T, S]``.
        cov: their covariances, ``[*B, T, S, S]``.
        forecast_mean: of each time, ``[*B, T, S]``.
        forecast_cov: its covariance, ``[*B, T, S, S]``.
        cross: covariance of the state before and the state at each time, ``[*B, T, S, S]``.
        open_cov: of the step to each time, ``[*B, T, S, S]``.
        follows: which elements are a step on from those before them, ``[*B, T]``; ``None`` for all.

    Returns:
        The smoothed means ``[*B, T, S]`` and covariances ``[*B, T, S, S]``.
    """
    batch, count = mean.shape[:-2], mean.shape[-2]
    gain, last = smoothing_gain(cross[..., 1:, :, :], forecast_cov[..., 1:, :, :]), torch.zeros_like(cov[..., :1, :, :])
    own = cov[..., :-1, :, :]
    rest = own - gain @ cross[..., 1:, :, :].mT if open_cov is None else open_cov[..., 1:, :, :]
    shift = mean[..., :-1, :] - (gain @ forecast_mean[..., 1:, :].unsqueeze(-1)).squeeze(-1)
    ends = torch.ones(*batch, count, dtype=torch.bool, device=mean.device)
    ends[..., :-1] = False if follows is None else ~follows[..., 1:]
    shift = torch.where(ends[..., :-1].unsqueeze(-1), mean[..., :-1, :], shift)
    rest = torch.where(ends[..., :-1, None, None], own, rest)
    steps = (
        torch.cat([gain, last], -3),
        torch.cat([shift, mean[..., -1:, :]], -2).unsqueeze(-1),
        torch.cat([rest, cov[..., -1:, :, :]], -3),
        ends[..., None, None],
    )
    _, moved, left, _ = prefixes(_one_after_the_other, tuple(_backwards(value, len(batch)) for value in steps))
    left = (left + left.mT) / 2
    return moved.squeeze(-1).flip(0).movedim(0, -2), left.flip(0).movedim(0, -3)


def _backwards(value: Tensor, time: int) -> Tensor:
    return value.movedim(time, 0).flip(0)


def _one_after_the_other(later: Sequence[Tensor], earlier: Sequence[Tensor]) -> _Elements:
    """Joins steps back in time; nothing of what is later, NaN neither, passes the end of an episode."""
    (gain, shift, rest, ends), (own_gain, own_shift, own_rest, own_ends) = later, earlier
    moved, left = own_gain @ shift + own_shift, own_gain @ rest @ own_gain.mT + own_rest
    return (
        torch.where(own_ends, own_gain, own_gain @ gain),
        torch.where(own_ends, own_shift, moved),
        torch.where(own_ends, own_rest, left),
        own_ends | ends,
    )
