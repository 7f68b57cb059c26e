"""Replays a recorded drive as an environment, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded

from torch_denkf.applications.car.kitti.drive import read_kitti_drive
from torch_denkf.applications.car.kitti.frames import frames_at
from torch_denkf.envs.rows import RowsEnv

__all__ = ["KITTIReplayEnv"]


class KITTIReplayEnv(RowsEnv):
    """Replays sub-sequences of one KITTI drive, one for each element of the batch, in lockstep.

    At reset and at each step it returns row t of :func:`torch_denkf.applications.car.kitti.frames.drive_frames`:

    ============ ================ ====================================================================================
    key          shape            content
    ============ ================ ====================================================================================
    ``pixels``   ``[*B,2C,H,W]``  float32: frame t in [0, 1], then the difference of frames t and t-1; C = 3 in colour;
                                  if the drive has images
    ``flow``     ``[*B,3,h,w]``   float32, if the drive has it: see :func:`torch_denkf.applications.car.with_motion`
    ``road``     ``[*B,p,s]``     float32, if the drive has it
    ``observed`` ``[*B,1]``       bool: frames t and t-1 both exist; missing pixels are zero
    ``steps``    ``[*B,1]``       int64, if the drive has it: see ``kitti.gaps.bridge_gaps``
    ``state``    ``[*B,5]``       float32, ground truth: x m, y m, θ rad, v m/s, θ_dot rad/s (backward differences)
    ``is_init``  ``[*B,1]``       bool: an episode starts here
    ``time``     ``[*B,1]``       float64, s, time of the drive
    ============ ================ ====================================================================================

    An episode has ``length`` frames, including the one at reset: it is truncated after ``length - 1`` steps. Rows may
    end at different steps; a reset restarts only the rows that ``"_reset"`` marks. The difference at reset is to the
    frame before, if there is one. Rewards are zero.

    A replay has no actions. TorchRL's batched environments and rollouts work with an empty action spec, but its
    collectors (0.14) do not, so the ``"action"`` here has **width zero**: rollouts without policy, SerialEnv,
    ParallelEnv and Collector with ``policy=None`` work as they are. A policy need not write it, except in a Collector
    over a ParallelEnv, which requires all input keys from the policy: put the filter in a transform there.

    Args:
        drive: folder with ``sequences`` and ``poses``, or a drive from
            :func:`torch_denkf.applications.car.read_kitti_drive` or :func:`torch_denkf.applications.car.with_motion`.
        sequence: name of the sequence, if ``drive`` is a folder.
        batch_size: ``*B``.
        start: row of the drive at which episodes start: a number, a tensor that expands to ``*B``, or ``"random"``:
            drawn at each reset, uniformly among the rows with ``length`` frames left.
        length: frames of an episode, at least 2: a number, or one for each element; by default up to the drive's end.
        size: (H, W) of the frames, if ``drive`` is a folder; likewise ``camera``, ``colour`` and ``cache``, see
            :func:`torch_denkf.applications.car.read_kitti_drive`.
        camera: folder of the images.
        colour: True for three channels, False for a grey one, None for the channels of the files.
        cache: folder of the decoded drive.
        seed: seed of the random starts; by default drawn from torch's generator. ``set_seed`` sets it again, and gives
            each worker of a ParallelEnv its own.
        device: device of all outputs; the whole drive is moved there. By default the drive's.

    Raises:
        TypeError: if ``sequence`` is missing for a folder, or given for a drive.
        ValueError: if an episode does not fit in the drive, or random starts are used without ``length``.

    Examples:
        >>> from torch_denkf.applications.car.kitti.render import write_drives
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> write_drives(folder, ["town"], frames=20)
        ['town']
        >>> env = KITTIReplayEnv(folder, "town", batch_size=[2], start=[0, 5], length=10, cache=None)
        >>> rollout = env.rollout(100)
        >>> rollout["next", "pixels"].shape
        torch.Size([2, 9, 6, 50, 150])
    """

    def __init__(
        self,
        drive: str | Path | TensorDictBase,
        sequence: str | int | None = None,
        *,
        batch_size: Sequence[int] = (),
        start: int | Sequence[int] | Tensor | Literal["random"] = 0,
        length: int | Sequence[int] | Tensor | None = None,
        size: tuple[int, int] = (50, 150),
        camera: str | None = None,
        colour: bool | None = True,
        cache: str | Path | bool | None = True,
        seed: int | None = None,
        device: torch.device | str | None = None,
    ):
        if isinstance(drive, TensorDictBase):
            if sequence is not None:
                raise TypeError("pass either a folder and a sequence or a drive that is already read, not both")
        elif sequence is None:
            raise TypeError("name the sequence to replay, such as sequence='09'; list_kitti_drives(folder) lists them")
        else:
            drive = read_kitti_drive(drive, sequence, camera=camera, size=size, colour=colour, cache=cache)
        super().__init__(batch_size, seed, device)
        self.drive = drive if device is None else drive.to(device)
        self.dt = float(drive["dt"][0])  # s
        self._set_stretches(start, length)
        shape = frames_at(self.drive, self._starts).get("pixels", torch.zeros(0)).shape
        self._set_specs(self._starts, pixels=Bounded(low=-1.0, high=1.0, shape=shape, dtype=torch.float32))

    def _set_stretches(self, start, length) -> None:
        rows, where = self.drive.batch_size[0], self.drive["state"].device
        self._random = isinstance(start, str)
        if self._random and start != "random":
            raise ValueError(f"start is a row, one for each element of the batch, or 'random', got {start!r}")
        if self._random and length is None:
            raise ValueError("random starts need the number of frames of an episode: pass length")
        for name, value in (("start", 0 if self._random else start), ("length", length)):
            if value is not None and not _is_whole(value):
                raise TypeError(f"{name} is a whole number, or one for each element of the batch; got {value!r}")
        begin = torch.as_tensor(0 if self._random else start, device=where).expand(self.batch_size)
        frames = rows - begin if length is None else torch.as_tensor(length, device=where).expand(self.batch_size)
        if bool(((frames < 2) | (begin < 0) | (begin + frames > rows)).any()):
            raise ValueError(
                f"episodes of length={frames.tolist()} from start={begin.tolist()} do not fit in a drive of {rows} "
                "rows; they need at least 2 frames and must end within the drive"
            )
        self._starts, self._lengths, self._rows = begin, frames, rows

    def _rows_at(self, row: Tensor) -> TensorDict:
        return frames_at(self.drive, row)

    def _choose(self, starts: Tensor) -> tuple[Tensor, Tensor]:
        first = self._draw(self._rows - self._lengths + 1) if self._random else self._starts
        return first, first + self._lengths - 1


def _is_whole(value: object) -> bool:
    try:
        kind = torch.as_tensor(value).dtype
    except (TypeError, ValueError, RuntimeError):
        return False
    return not (kind.is_floating_point or kind.is_complex or kind == torch.bool)
