"""Missing frames in a drive: pairs each frame with the last existing one."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf._checks import check_count
from torch_denkf.applications.car.kitti.clock import GAP

__all__ = ["bridge_gaps", "steps_between"]


def bridge_gaps(drive: TensorDictBase, longest: int = 3) -> TensorDict:
    """Pairs each frame with the last existing one before it, so that a gap loses no motion.

    Otherwise each missing frame makes two pairs of neighbours unobserved. Afterwards
    :func:`torch_denkf.applications.car.kitti.frames.frames_at`, :func:`torch_denkf.applications.car.with_motion` and
    :class:`torch_denkf.applications.car.KITTIReplayEnv` compute differences and optical flow over these pairs; the
    filter needs a :class:`torch_denkf.applications.car.modules.pairs.PairObservation`.

    Args:
        drive: drive from :func:`torch_denkf.applications.car.read_kitti_drive`, batch size ``[N]``.
        longest: largest number of steps between the frames of a pair; 1 pairs neighbours only.

    Returns:
        A shallow copy of the drive with ``"steps"`` ``[N, 1]``, int64: steps back to the first frame of the pair; 0 if
        this frame is missing, or there is none within ``longest`` steps.

    Raises:
        TypeError: if ``longest`` is no whole number.
        ValueError: if it is not positive.

    No pair crosses a gap in the drive's times (see ``"dt"``).

    Examples:
        >>> drive = TensorDict({"frame_valid": torch.tensor([1, 1, 0, 0, 1, 1, 0, 0, 0, 1]).bool().unsqueeze(-1)}, [10])
        >>> bridge_gaps(drive)["steps"].flatten().tolist()
        [0, 1, 0, 0, 3, 1, 0, 0, 0, 0]
    """
    check_count("longest", longest, cure="It counts the steps between the frames of a pair")
    steps = steps_between(drive["frame_valid"].squeeze(-1), longest)
    after = after_gap(drive)
    if after is not None:
        begun = after.cumsum(0)  # segment number of each row; a pair lies within a segment
        row = torch.arange(len(begun), device=begun.device)
        steps = torch.where(begun[row - steps] == begun, steps, 0)
    return drive.copy().set("steps", steps.unsqueeze(-1))


def after_gap(drive: TensorDictBase) -> Tensor | None:
    """Masks rows that come after a gap in time, bool ``[N]``; ``None`` if there is none."""
    dt = drive.get("dt", None)
    if dt is None or not dt.numel():
        return None
    after = (dt > GAP * dt.median()).squeeze(-1)
    return after if bool(after.any()) else None


def steps_between(valid: Tensor, longest: int) -> Tensor:
    """Returns steps from each frame back to the last existing one, int64 ``[*B, N]``: see :func:`bridge_gaps`.

    Args:
        valid: mask of existing frames, bool ``[*B, N]``, time last.
        longest: as in :func:`bridge_gaps`.
    """
    row = torch.arange(valid.shape[-1], device=valid.device)
    never = -longest - 1
    last = torch.where(valid, row, never).cummax(-1).values  # the last existing frame, including this one
    steps = row - torch.cat([torch.full_like(last[..., :1], never), last[..., :-1]], -1)
    return torch.where(valid & (steps <= longest), steps, 0)


def steps_at(drive: TensorDictBase, index: Tensor) -> Tensor:
    """Returns the number of steps between a frame and the first frame of its pair, ``[*B, 1]``; 0 for none.

    Without :func:`bridge_gaps`, pairs are neighbours.
    """
    if "steps" in drive:
        return drive["steps"][index]
    before = drive["frame_valid"][(index - 1).clamp_min(0)]
    pairs = drive["frame_valid"][index] & before & (index > 0).unsqueeze(-1)
    after = after_gap(drive)
    return (pairs if after is None else pairs & ~after[index].unsqueeze(-1)).long()
