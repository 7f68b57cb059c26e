"""The backward pass of a smoother: from the last belief of a sequence to the first."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_denkf._checks import check_count, check_shape


def run_backward(
    step: Callable[[Sequence[Tensor], Sequence[Tensor], Sequence[Tensor]], Sequence[Tensor]],
    time: int,
    beliefs: Sequence[Tensor],
    links: Sequence[Tensor],
    *,
    follows: Tensor | None,
    lag: int | None,
) -> tuple[Tensor, ...]:
    """Smooths the beliefs of a whole sequence.

    Args:
        step: returns smoothed beliefs, from the beliefs, their links to the next time, and its smoothed beliefs.
        time: the dimension of time, behind those of the batch.
        beliefs: entries of the filter's beliefs, ``[*B, T, *]``.
        links: entries computed in the step from the belief before to each time, ``[*B, T, *]``.
        follows: boolean ``[*B, T]``; False if an element is not one step on from the one before. None: all are.
        lag: number of later readings: the belief of t given those up to t + lag. None: all of the sequence.

    Returns:
        The smoothed entries, ``[*B, T, *]`` each.

    Raises:
        ValueError: if ``follows`` has another shape, or ``lag`` is negative.
    """
    check_lag(lag)
    if follows is not None:
        check_shape("follows", follows, beliefs[0].shape[: time + 1], "[*B, T]")
    last = beliefs[0].shape[time] - 1

    def back(begin: int, count: int, later: Sequence[Tensor]) -> list[Tensor]:
        own = [value.narrow(time, begin, count) for value in beliefs]
        new = step(own, [value.narrow(time, begin + 1, count) for value in links], later)
        if follows is None:
            return list(new)
        joined = follows.narrow(time, begin + 1, count)
        rows = [joined.reshape(*joined.shape, *[1] * (value.ndim - joined.ndim)) for value in own]
        return list(map(torch.where, rows, new, own))

    end = [value.narrow(time, last, 1) for value in beliefs]
    if lag is None or lag >= last:
        out = [end]
        for t in range(last - 1, -1, -1):
            out.append(back(t, 1, out[-1]))
        return tuple(torch.cat(values, time) for values in zip(*out[::-1], strict=True))
    smoothed = list(beliefs)
    for _ in range(lag):  # all times at once: each round adds one more later reading
        moved = back(0, last, [value.narrow(time, 1, last) for value in smoothed])
        smoothed = [torch.cat(both, time) for both in zip(moved, end, strict=True)]
    return tuple(smoothed)


def check_lag(lag: int | None) -> None:
    """Raises unless ``lag`` is ``None`` or a whole number, 0 or more."""
    if lag is not None:
        check_count("lag", lag, least=0, cure="It is the number of later readings; None uses all")
