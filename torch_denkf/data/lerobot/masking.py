"""Masks invalid rows of a recording, keeps them in place, and counts them in a warning."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.data.times import MOST_WRONG, filled, sound

__all__ = ["mask_invalid_rows", "repaired_times"]

OFF = 0.25  # largest relative error of the median step against 1 / fps
_NUMBERS = ("state", "action")


def repaired_times(times: np.ndarray, fps: float, source: str) -> tuple[np.ndarray, np.ndarray]:
    """Returns times of an episode with invalid ones interpolated, s, and the mask of valid ones; ``[n]`` each.

    Args:
        times: stored times, s.
        fps: rows per second.
        source: file and episode, for the message.

    Raises:
        ValueError: if more than a tenth are not finite or do not increase, or they are not ``1 / fps`` apart.
    """
    try:
        times = np.asarray(times, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{source}: a timestamp is no number ({error}); download it again") from error
    good = sound(times)
    wrong = np.flatnonzero(~good)
    if len(wrong) > MOST_WRONG * len(times):
        raise ValueError(
            f"{source}: the timestamp {times[wrong[0]]:g} of frame {wrong[0]} does not increase, nor do "
            f"{len(wrong) - 1} others of {len(times)}; expected seconds that count frames, k / fps: download it again, "
            "or write them again"
        )
    step = float(np.median(np.diff(times[good]))) if good.sum() > 1 else 1 / fps
    if abs(step * fps - 1) > OFF:
        raise ValueError(
            f"{source}: timestamps are {step:.4g} s apart, but fps in meta/info.json is {fps:g}, which makes "
            f"{1 / fps:.4g} s; correct fps there, or write the timestamps again"
        )
    return (filled(times, good, 1 / fps) if len(wrong) else times), good


def mask_invalid_rows(rows: TensorDict, stamped: Tensor | None, source: str) -> TensorDict:
    """Masks rows with a non-finite state or action, or an invalid time.

    A ``state`` or ``action`` that is not finite is replaced by the last finite one of the episode. The row is not
    observed, and is left out of losses (``("collector", "mask")``) and, by ``NAME_observed``, out of statistics. A row
    with an invalid time is not observed. Warnings count both.

    Args:
        rows: batch size ``[N]``, with ``state``, ``observed``, ``episode``, ``frame`` and maybe ``action``; changed.
        stamped: mask of valid times, bool ``[N]``; ``None`` if all are valid.
        source: name of the recording, for the messages.

    Returns:
        The rows.

    Raises:
        ValueError: if an episode has no finite row.
    """
    if stamped is not None and not bool(stamped.all()):
        _warn(rows, ~stamped, source, "a timestamp that does not increase", "observed False")
        rows["observed"] &= stamped.unsqueeze(-1)
    for name in _NUMBERS:
        if name not in rows:
            continue
        finite = rows[name].isfinite().all(-1)
        if bool(finite.all()):
            continue
        what = f"observed and {name}_observed False, and are left out of losses"
        _warn(rows, ~finite, source, f"{name!r} that is not finite", what)
        rows[name] = rows[name][_last_sound(rows["episode"], finite, name, source)]
        rows[f"{name}_observed"] = finite.unsqueeze(-1)
        rows["observed"] &= finite.unsqueeze(-1)
        mask = rows.get(("collector", "mask"), None)
        rows["collector", "mask"] = finite if mask is None else mask & finite
    return rows


def _last_sound(episode: Tensor, finite: Tensor, name: str, source: str) -> Tensor:
    """Returns for each row the index of the last finite row of its episode up to it, or else of the next, ``[N]``."""
    row = torch.arange(len(episode))
    lengths = torch.unique_consecutive(episode, return_counts=True)[1]
    first = (lengths.cumsum(0) - lengths).repeat_interleave(lengths)
    last = torch.where(finite, row, -1).cummax(0).values
    following = torch.where(finite, row, len(row)).flip(0).cummin(0).values.flip(0)
    end = first + lengths.repeat_interleave(lengths)
    index = torch.where(last >= first, last, following)
    empty = index >= end
    if bool(empty.any()):
        number = int(episode[empty][0])
        raise ValueError(
            f"{source}: no row of episode {number} has a {name!r} that is finite; download it again, or leave the "
            "episode out"
        )
    return index


def _warn(rows: TensorDict, wrong: Tensor, source: str, what: str, then: str) -> None:
    at = int(wrong.nonzero()[0])
    place = f"frame {int(rows['frame'][at])} of episode {int(rows['episode'][at])}"
    warnings.warn(
        f"{source}: {int(wrong.sum())} of {len(wrong)} rows have {what}, the first is {place}; they count as missing "
        f"({then})",
        stacklevel=4,
    )
