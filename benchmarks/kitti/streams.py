"""Streams of the study, one for each drive, camera and condition, computed once and cached on disk."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import torch
from tensordict import TensorDict
from torchrl.envs.transforms import Transform

from benchmarks.common.jobs import side_by_side
from torch_denkf.applications.car import read_kitti_drive, with_motion
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.frames import MOTION_KEYS
from torch_denkf.data.cache import cached
from torch_denkf.envs import BlackFrames, Blur, Brightness, OccludingBox, SaltAndPepper

SMALL = (50, 150)  # rows and columns of the image sensor's input, as in the paper
LONGEST = 3  # largest number of steps between two frames that the flow sensor compares over a gap
MISSING = 0.3  # share of frames that do not arrive, and of black ones, as in the paper

#: Disturbances of every image of a drive. "missing" is a mask, and needs no other images.
DISTURBANCES = {
    "salt_and_pepper": lambda generator: SaltAndPepper(in_keys=["image"], generator=generator),
    "blur": lambda generator: Blur(in_keys=["image"], generator=generator),
    "brightness": lambda generator: Brightness(in_keys=["image"], generator=generator),
    "black": lambda generator: BlackFrames(MISSING, in_keys=["image"], generator=generator),
    "box": lambda generator: OccludingBox(in_keys=["image"], generator=generator),
}
CONDITIONS = ("clean", *DISTURBANCES, "missing")


@dataclass(frozen=True)
class Stream:
    """One camera's images of one drive under one condition."""

    root: str
    drive: str
    camera: str
    condition: str = "clean"
    size: tuple[int, int] = (125, 414)  # of the images from which the flow is computed
    pitch: float = 0.0  # rad, error of the camera's assumed pitch, which the sensor must estimate
    steps: int = 1  # between the two frames of a pair

    @property
    def name(self) -> str:
        """Returns drive and camera."""
        return f"{self.drive}/{self.camera}"

    def seed(self) -> int:
        """Returns the seed of the condition, the same in each run."""
        what = (self.drive, self.camera, self.condition, self.size, self.pitch, self.steps)
        return int.from_bytes(hashlib.blake2b(repr(what).encode(), digest_size=4).digest(), "big")

    def read(self, cache: Path) -> TensorDict:
        """Returns flow, road, small grey images and the truth, ``[N]``; memory-mapped."""
        name = f"{self.drive}-{self.camera}-{self.condition}-{self.seed():08x}"
        return cached(cache / name, self._compute)

    def _drive(self) -> TensorDict:
        """Returns the drive's images at full size, disturbed by the condition."""
        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        drive = read_kitti_drive(self.root, self.drive, camera=self.camera, size=self.size, colour=False, cache=None)
        if self.pitch:
            drive["calibration"][:, 3] += self.pitch * drive["calibration"][:, 1]
        if self.condition != "clean":
            seed = replace(self, steps=1).seed()  # the same images for pairs of all lengths
            disturb: Transform = DISTURBANCES[self.condition](torch.Generator().manual_seed(seed))
            drive = disturb(drive)
        return drive

    def _compute(self) -> TensorDict:
        """Returns flow, road and corners of the drive, and its images at small size."""
        drive = self._drive()
        valid = drive["frame_valid"]
        paired = valid & torch.cat([torch.zeros_like(valid[: self.steps]), valid[: -self.steps]])
        drive = with_motion(drive.copy().set("steps", self.steps * paired.long()), cache=None, two_view=True)
        small = [cv2.resize(image[0].numpy(), SMALL[::-1], interpolation=cv2.INTER_AREA) for image in drive["image"]]
        return drive.set("image", torch.stack([torch.from_numpy(image) for image in small]).unsqueeze(1))


def find_streams(root: Path, size: tuple[int, int], drives: list[str] | None = None) -> list[Stream]:
    """Returns every camera of every drive below ``root`` that has images and poses."""
    found = drives or list_kitti_drives(root)
    if not found:
        raise FileNotFoundError(f"no drive below {root} has both images and poses")
    streams = []
    for drive in found:
        folder = Path(root) / "sequences" / drive
        cameras = [camera for camera in ("image_2", "image_3") if any((folder / camera).glob("*.png"))]
        cameras = cameras or [camera for camera in ("image_0", "image_1") if any((folder / camera).glob("*.png"))]
        streams += [Stream(str(root), drive, camera, size=tuple(size)) for camera in cameras]
    return streams


def prepare(streams: list[Stream], cache: Path, processes: int) -> None:
    """Computes the streams that are not on disk, drives in parallel."""
    cache.mkdir(parents=True, exist_ok=True)
    side_by_side([partial(_prepare, stream, cache) for stream in streams], processes, "flow of all drives")


def _prepare(stream: Stream, cache: Path) -> None:
    stream.read(cache)


def spans(stream: Stream, sensor: str) -> list[Stream]:
    """Returns the same drive in pairs of 1, 2, ... steps, which a sensor reads over missing frames."""
    longest = LONGEST if sensor == "flow" and stream.condition == "clean" else 1
    return [replace(stream, steps=steps) for steps in range(1, longest + 1)]


def read_by(sensor: str, stream: TensorDict) -> TensorDict:
    """Returns a stream without the entries that a sensor does not read."""
    return stream.exclude("image") if sensor == "flow" else stream.exclude(*MOTION_KEYS)
