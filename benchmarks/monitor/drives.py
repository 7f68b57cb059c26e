"""Drives whose camera fails without a word: what a trained sensor reads of them."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.data import read_kitti_drive, with_motion
from torch_denkf.data.cache import cached
from torch_denkf.odometry.streams import read_sensor
from torch_denkf.pretrained import from_pretrained
from torch_denkf.transforms import BlackFrames, Brightness, OccludingBox

__all__ = ["FAULTS", "failing", "stretches"]

LENGTH, PERIOD = 20, 60  # frames that a fault lasts, and between the beginnings of two
#: What happens to the pictures of a stretch; over a whole drive with "-all", which black frames do to three in ten.
FAULTS: dict[str, Callable[[torch.Generator], object]] = {
    "black": lambda generator: BlackFrames(1.0, in_keys=("image",), generator=generator),
    "box": lambda generator: OccludingBox(in_keys=("image",), generator=generator),
    "exposure": lambda generator: Brightness((6.0, 6.0), (0.1, 0.1), in_keys=("image",), generator=generator),
}
ALWAYS: dict[str, Callable[[torch.Generator], object]] = {
    "black-all": lambda generator: BlackFrames(0.3, in_keys=("image",), generator=generator),
    "box-all": lambda generator: OccludingBox(in_keys=("image",), generator=generator),
}


def stretches(frames: int) -> Tensor:
    """Which of so many frames are of a fault, ``[frames]``."""
    number = torch.arange(frames)
    return (number % PERIOD >= PERIOD - LENGTH) & (number < frames // PERIOD * PERIOD)


def failing(root: Path, name: str, fault: str, cache: Path, steps: int = 1) -> TensorDict:
    """Readings of the trained sensor of a whole drive ``[N]`` with a fault, and whether a picture of the pair is of it.

    Args:
        root: folder in KITTI's layout.
        name: of the drive.
        fault: ``"clean"``, or of ``FAULTS`` or ``ALWAYS``.
        cache: folder in which readings are kept.
        steps: between the two pictures of a pair.
    """
    entry = f"{name}-{fault}" if steps == 1 else f"{name}-{fault}-{steps}"
    return cached(cache / entry, lambda: _compute(root, name, fault, steps))


def _compute(root: Path, name: str, fault: str, steps: int) -> TensorDict:
    torch.set_num_threads(1)
    car = from_pretrained("car-odometry")
    drive = read_kitti_drive(root, name, size=car.settings.size, colour=False, cache=None).copy()
    seed = zlib.crc32(f"{name} {fault}".encode())
    generator, hit = torch.Generator().manual_seed(seed), torch.zeros(len(drive), dtype=torch.bool)
    image = drive["image"].clone()
    if fault in FAULTS:
        hit = stretches(len(drive))
        image[hit] = FAULTS[fault](generator)(TensorDict({"image": image[hit]}, [int(hit.sum())]))["image"]
    elif fault in ALWAYS:
        before = image
        image = ALWAYS[fault](generator)(TensorDict({"image": image.clone()}, [len(drive)]))["image"]
        hit = (image != before).flatten(1).any(-1)
    drive["image"] = image
    valid = drive["frame_valid"]
    drive["steps"] = steps * (valid & torch.cat([torch.zeros_like(valid[:steps]), valid[:-steps]])).long()
    data = with_motion(drive, cache=None, keep_images=False)
    out = read_sensor(car.sensor, data, car.settings.longest)
    pair = hit | torch.cat([hit[:steps] & False, hit[:-steps]])
    return out.set("fault", pair.unsqueeze(-1)).set("hit", hit.unsqueeze(-1))
