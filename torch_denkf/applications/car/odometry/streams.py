"""Training and test data of a car filter: optical flow of whole drives, and readings of a frozen sensor."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.applications.car.kitti.drive import read_kitti_drive
from torch_denkf.applications.car.kitti.frames import MOTION_KEYS, frames_at
from torch_denkf.applications.car.kitti.gaps import steps_between
from torch_denkf.applications.car.kitti.mirror import mirror_drive
from torch_denkf.applications.car.kitti.motion import with_motion
from torch_denkf.applications.car.modules.flow_sensor import FlowSensor
from torch_denkf.applications.car.odometry.filter import VELOCITIES
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.envs import BlackFrames, Blur, Brightness, OccludingBox, SaltAndPepper

__all__ = [
    "CONDITIONS",
    "Drive",
    "all_frames",
    "lose_frames",
    "mirror",
    "read_sensor",
    "read_spans",
    "rows",
    "shortest_spans",
    "take_spans",
]

MISSING = 0.3  # share of black, or missing, frames

_DISTURBANCES = {
    "salt_and_pepper": lambda generator: SaltAndPepper(in_keys=("image",), generator=generator),
    "blur": lambda generator: Blur(in_keys=("image",), generator=generator),
    "brightness": lambda generator: Brightness(in_keys=("image",), generator=generator),
    "black": lambda generator: BlackFrames(MISSING, in_keys=("image",), generator=generator),
    "box": lambda generator: OccludingBox(in_keys=("image",), generator=generator),
}
CONDITIONS = ("clean", *_DISTURBANCES)


@dataclass(frozen=True)
class Drive:
    """Images of one camera of a drive, under one condition, in pairs of a fixed number of steps.

    Attributes:
        root: folder with ``sequences`` and ``poses``.
        name: name of the drive.
        size: (H, W) of the scaled images.
        cache: folder of the cached flow; ``True`` for the library's.
        condition: ``"clean"``, or a disturbance of the images, one of ``CONDITIONS``.
        steps: steps between the two frames of a pair.
        pitch: error of the assumed pitch of the camera, rad, which the sensor must learn to estimate.
        height: height of the camera over the road, in m.
        weight: share of the batches.
        camera: folder of the images; by default the first that has any.
        two_view: whether corners are tracked, too.
    """

    root: Path
    name: str
    size: tuple[int, int]
    cache: Path | str | bool
    condition: str = "clean"
    steps: int = 1
    pitch: float = 0.0
    height: float = KITTI_HEIGHT
    weight: float = 1.0
    camera: str | None = None
    two_view: bool = False

    def disturbed(self) -> list[Drive]:
        """Returns this drive clean, and under all disturbances with half the weight together."""
        share = 0.5 * self.weight / len(_DISTURBANCES)
        return [self, *(replace(self, condition=name, weight=share) for name in _DISTURBANCES)]

    def longer(self, longest: int) -> list[Drive]:
        """Returns this drive in pairs of 2 to ``longest`` steps, with less weight, for the training of a sensor."""
        return [replace(self, steps=steps, weight=0.5**steps * self.weight) for steps in range(2, longest + 1)]

    def spans(self, longest: int) -> list[Drive]:
        """Returns this drive in pairs of 1 to ``longest`` steps; a disturbed one only in pairs of neighbours."""
        return [replace(self, steps=steps) for steps in range(1, (longest if self.condition == "clean" else 1) + 1)]

    def read(self) -> TensorDict:
        """Returns flow, road correlation and ground truth, ``[N]``, memory-mapped."""
        drive = read_kitti_drive(
            self.root, self.name, camera=self.camera, size=self.size, colour=False, cache=self.cache
        )
        drive = drive.copy()
        if self.pitch:
            calibration = drive["calibration"].clone()
            calibration[:, 3] += self.pitch * calibration[:, 1]
            drive["calibration"] = calibration
        if self.condition != "clean":
            seed = zlib.crc32(f"{self.name} {self.condition}".encode())
            drive["image"], drive["frame_valid"] = drive["image"].clone(), drive["frame_valid"].clone()
            drive = _DISTURBANCES[self.condition](torch.Generator().manual_seed(seed))(drive)
        valid = drive["frame_valid"]
        paired = valid & torch.cat([torch.zeros_like(valid[: self.steps]), valid[: -self.steps]])
        drive["steps"] = self.steps * paired.long()
        return with_motion(drive, height=self.height, cache=self.cache, keep_images=False, two_view=self.two_view)


def rows(data: TensorDict, index: Tensor, longest: int) -> TensorDict:
    """Returns the sensor's inputs and targets of rows of a drive.

    ``"target_observation"`` ``[*B, 2]`` is the sum of the true velocities over all steps of the pair.
    """
    frames = frames_at(data, index)
    lags = torch.arange(longest)
    velocity = data["state"][(index.unsqueeze(-1) - lags).clamp_min(0)][..., VELOCITIES]
    return frames.set("target_observation", (velocity * (lags < frames["steps"]).unsqueeze(-1)).sum(-2))


def mirror(frames: TensorDict) -> TensorDict:
    """Mirrors frames: sideways motion and turns change sign."""
    mirrored = mirror_drive(frames)
    return mirrored.set("target_observation", frames["target_observation"] * torch.tensor([1.0, -1.0]))


@torch.no_grad()
def read_sensor(sensor: FlowSensor, data: TensorDict, longest: int, *, mirrored: bool = False) -> TensorDict:
    """Returns a sensor's readings of a whole drive ``[N]``, on the CPU, with fixed random numbers."""
    readings, was_training, device = [], sensor.training, next(sensor.parameters()).device
    sensor.eval()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for index in torch.arange(len(data)).split(256):
            frames = rows(data, index, longest)
            frames = (mirror(frames) if mirrored else frames).to(device)
            readings.append(sensor(frames).exclude(*MOTION_KEYS).cpu())
    sensor.train(was_training)
    return TensorDict.cat(readings)


def read_spans(sensor: FlowSensor, drives: Sequence[TensorDict], longest: int, *, mirrored: bool = False) -> TensorDict:
    """Returns a sensor's readings of one drive in pairs of 1, 2, ... steps.

    Args:
        sensor: the sensor.
        drives: the drive in pairs of 1, 2, ... steps, each ``[N]``; see :meth:`Drive.spans`.
        longest: K, largest number of steps in the result; pairs without a drive are not observed.
        mirrored: whether to mirror the drive.

    Returns:
        ``[N]``: ``"state"`` ``[N, 5]``; ``("spans", "observed")`` ``[N, K, 1]``, ``("spans", "ensemble")``
        ``[N, K, E, 2]`` and ``("spans", "encoding")`` ``[N, K, features]``.
    """
    read = [read_sensor(sensor, data, longest, mirrored=mirrored) for data in drives]
    spans = {}
    for name, key in (
        ("observed", "observed"),
        ("ensemble", ("sensor", "ensemble")),
        ("encoding", ("sensor", "encoding")),
    ):
        values = [each[key] for each in read]
        spans[name] = torch.stack([*values, *[torch.zeros_like(values[0])] * (longest - len(values))], 1)
    count = len(read[0])
    return TensorDict({"state": read[0]["state"], "spans": TensorDict(spans, [count, longest])}, [count])


def take_spans(readings: TensorDict, steps: Tensor) -> TensorDict:
    """Selects readings of pairs ``steps`` apart, ``[*B]``, from those of 1, 2, ... steps; 0 marks a missing pair.

    Returns:
        A copy with the inputs of a filter without its sensor: ``"observed"`` and ``"steps"`` ``[*B, 1]``, ``"sensor"``.
    """
    spans = readings["spans"]
    index = (steps - 1).clamp(0, spans.shape[-1] - 1).unsqueeze(-1)
    taken = {}
    for key in ("observed", "ensemble", "encoding"):
        value = spans[key]
        where = index.reshape(*index.shape, *[1] * (value.ndim - index.ndim))
        where = where.expand(*index.shape, *value.shape[steps.ndim + 1 :])
        taken[key] = value.gather(steps.ndim, where).squeeze(steps.ndim)
    steps = torch.where(steps > spans.shape[-1], 0, steps).unsqueeze(-1)
    seen = taken.pop("observed") & (steps > 0)
    sensor = TensorDict(taken, batch_size=readings.batch_size)
    return readings.select("state").clone().update({"observed": seen, "steps": steps, "sensor": sensor})


def lose_frames(readings: TensorDict, seed: int, share: float = MISSING) -> TensorDict:
    """Drops random frames: returns the sensor's readings of pairs of the remaining ones."""
    kept = torch.rand(len(readings), generator=torch.Generator().manual_seed(seed)) >= share
    return take_spans(readings, steps_between(kept, readings["spans"].shape[-1]))


def shortest_spans(readings: TensorDict) -> TensorDict:
    """Returns the sensor's reading of the shortest observed pair, for each frame."""
    seen = readings["spans", "observed"].squeeze(-1)
    return take_spans(readings, torch.where(seen.any(-1), seen.int().argmax(-1) + 1, 0))


def all_frames(readings: TensorDict) -> TensorDict:
    """Returns the sensor's readings of neighbouring frames."""
    return take_spans(readings, torch.ones(len(readings), dtype=torch.int64))
