"""Input frames of a network with the difference to the frame before, the same for training and replay.

:class:`torch_denkf.applications.car.KITTIReplayEnv` and the training data both come from :func:`frames_at`.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf.applications.car.kitti.gaps import steps_at

__all__ = ["drive_frames", "frames_at", "mark_start"]

MOTION_KEYS = ("flow", "road", "two_view")  # entries of with_motion


def frames_at(drive: TensorDictBase, index: Tensor) -> TensorDict:
    """Returns frames of a drive by row number.

    ============ ================ ====================================================================================
    key          shape            content
    ============ ================ ====================================================================================
    ``pixels``   ``[*B,2C,H,W]``  float32: the frame t in [0, 1], then the difference of frames t and t-1 in [-1, 1];
                                  if the drive has ``image``
    ``flow``     ``[*B,3,h,w]``   float32, if the drive has it: see :func:`torch_denkf.applications.car.with_motion`
    ``road``     ``[*B,p,s]``     float32, if the drive has it
    ``two_view`` ``[*B,8]``       float32, if the drive has it
    ``state``    ``[*B,5]``       float32, see :func:`torch_denkf.applications.car.read_kitti_drive`
    ``observed`` ``[*B,1]``       bool: both frames exist, so that the difference is valid
    ``steps``    ``[*B,1]``       int64, if the drive has it: steps between the two frames, which then need not be
                                  neighbours, see ``kitti.gaps.bridge_gaps``
    ``time``     ``[*B,1]``       float64, s
    ============ ================ ====================================================================================

    Missing values are zero: all pixels if frame t is missing; the difference, the flow and the road if frame t-1 is
    missing. The first row of a drive has no frame before it and is not observed.

    Args:
        drive: drive from :func:`torch_denkf.applications.car.read_kitti_drive` or
            :func:`torch_denkf.applications.car.with_motion`, batch size ``[N]``. A drive with flow need not have
            images.
        index: rows, int64 ``[*B]``, in [0, N).

    Returns:
        The frames, batch size ``*B``, on the drive's device.

    Raises:
        KeyError: if ``drive`` lacks a key.
    """
    missing = {"frame_valid", "state", "time"} - set(drive.keys())
    if not {"image", "flow"} & set(drive.keys()):
        missing.add("image")
    if missing:
        raise KeyError(
            f"the drive lacks {sorted(missing)}; pass what torch_denkf.applications.car.read_kitti_drive returns"
        )
    valid, steps = drive["frame_valid"][index], steps_at(drive, index)
    observed = steps > 0
    entries = {"state": drive["state"][index], "observed": observed, "time": drive["time"][index]}
    if "steps" in drive:
        entries["steps"] = steps
    if "image" in drive:
        frame = drive["image"][index].to(torch.float32)
        difference = frame - drive["image"][index - steps.squeeze(-1)]
        difference = torch.where(observed[..., None, None], difference, 0.0)
        entries["pixels"] = torch.cat([torch.where(valid[..., None, None], frame, 0.0), difference], -3).div_(255)
    for key in MOTION_KEYS:
        if key in drive:
            motion = drive[key][index].to(torch.float32)
            mask = observed.reshape(*observed.shape[:-1], *[1] * (motion.ndim - index.ndim))
            entries[key] = torch.where(mask, motion, 0.0)
    return TensorDict(entries, batch_size=index.shape, device=drive["state"].device)


def drive_frames(drive: TensorDictBase) -> TensorDict:
    """Returns all frames of a drive as training data, equal to a replay from its first row.

    Args:
        drive: drive from :func:`torch_denkf.applications.car.read_kitti_drive`, batch size ``[N]``.

    Returns:
        The entries of :func:`frames_at` and ``"is_init"`` ``[N, 1]``, True in row 0; batch size ``[N]``. Pixels are
        float32, four times the bytes of each channel's two uint8 frames: 180 kB a frame of 50 x 150 in colour. For long
        drives call :func:`frames_at` with the rows of each window instead.
    """
    rows = drive.batch_size[0]
    frames = frames_at(drive, torch.arange(rows, device=drive["state"].device))
    return mark_start(frames)


def mark_start(frames: TensorDict) -> TensorDict:
    """Returns frames ``[*B, T]`` with ``"is_init"``, true in the first of each row."""
    is_init = torch.zeros(*frames.batch_size, 1, dtype=torch.bool, device=frames.device)
    is_init[..., 0, :] = True
    return frames.set("is_init", is_init)
