"""Drives whose camera fails without a word: what the trained sensor reads of them."""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.data import read_kitti_drive, with_motion
from torch_denkf.data.cache import cached
from torch_denkf.filters import Filter
from torch_denkf.odometry import CarFilter
from torch_denkf.odometry.batches import mark_start
from torch_denkf.odometry.scores import first_state
from torch_denkf.odometry.streams import read_sensor, take_spans
from torch_denkf.pretrained import from_pretrained
from torch_denkf.transforms import BlackFrames, Brightness, OccludingBox

__all__ = ["ALWAYS", "FAULTS", "believed_spans", "car_filter", "failing", "filtered", "stretches"]

LENGTH, PERIOD = 20, 60  # frames that a fault lasts, and between the beginnings of two
_IMAGE = {"in_keys": ("image",)}
#: What happens to the pictures of a stretch.
FAULTS: dict[str, Callable] = {
    "black": partial(BlackFrames, 1.0, **_IMAGE),
    "box": partial(OccludingBox, **_IMAGE),
    "exposure": partial(Brightness, (6.0, 6.0), (0.1, 0.1), **_IMAGE),  # most of the street is white
}
#: What happens over a whole drive: three frames in ten are black, or a box hides 5 % of each.
ALWAYS: dict[str, Callable] = {
    "black-all": partial(BlackFrames, 0.3, **_IMAGE),
    "box-all": partial(OccludingBox, **_IMAGE),
}


def stretches(frames: int) -> Tensor:
    """Which of so many frames are of a fault, ``[frames]``."""
    number = torch.arange(frames)
    return (number % PERIOD >= PERIOD - LENGTH) & (number < frames // PERIOD * PERIOD)


def failing(root: Path, name: str, fault: str, cache: Path, steps: int = 1) -> TensorDict:
    """What the trained sensor reads of a whole drive ``[N]``; ``"fault"`` ``[N, 1]`` says which pairs of pictures are
    of the fault.

    Args:
        root: folder in KITTI's layout.
        name: of the drive.
        fault: ``"clean"``, or of ``FAULTS`` or ``ALWAYS``.
        cache: folder in which readings are kept.
        steps: between the two pictures of a pair.
    """
    entry = f"{name}-{fault}" if steps == 1 else f"{name}-{fault}-{steps}"
    return cached(cache / entry, lambda: _read(root, name, fault, steps))


def _read(root: Path, name: str, fault: str, steps: int) -> TensorDict:
    car = from_pretrained("car-odometry")
    drive = read_kitti_drive(root, name, size=car.settings.size, colour=False, cache=None).copy()
    image, hit = drive["image"].clone(), torch.zeros(len(drive), dtype=torch.bool)
    generator = torch.Generator().manual_seed(zlib.crc32(f"{name} {fault}".encode()))
    if fault in FAULTS:
        hit = stretches(len(drive))
        if hit.any():
            part = TensorDict({"image": image[hit]}, [int(hit.sum())])
            image[hit] = FAULTS[fault](generator=generator)(part)["image"]
    elif fault in ALWAYS:
        image = ALWAYS[fault](generator=generator)(TensorDict({"image": image}, [len(drive)]))["image"]
        hit = (image != drive["image"]).flatten(1).any(-1)
    drive["image"] = image
    valid = drive["frame_valid"]
    drive["steps"] = steps * (valid & torch.cat([torch.zeros_like(valid[:steps]), valid[:-steps]])).long()
    out = read_sensor(car.sensor, with_motion(drive, cache=None, keep_images=False), car.settings.longest)
    pair = hit | torch.cat([torch.zeros(steps, dtype=torch.bool), hit[:-steps]])
    return out.set("fault", pair.unsqueeze(-1))


def believed_spans(spans: Sequence[TensorDict], doubt: Callable[[TensorDict], Tensor]) -> TensorDict:
    """Of pairs of 1, 2, ... steps the shortest that is not doubted; none where all are: readings ``[N]``.

    Args:
        spans: what the sensor reads of them, ``[N]`` each.
        doubt: of readings, ``[N]``: whether to take another pair.
    """
    values = {
        name: torch.stack([each[key] for each in spans], 1)
        for name, key in (
            ("observed", "observed"),
            ("ensemble", ("sensor", "ensemble")),
            ("encoding", ("sensor", "encoding")),
        )
    }
    size = torch.Size([len(spans[0]), len(spans)])
    readings = TensorDict({"state": spans[0]["state"], "spans": TensorDict(values, size)}, size[:1])
    good = torch.stack([each["observed"].squeeze(-1) & ~doubt(each) for each in spans], -1)
    steps = torch.where(good.any(-1), good.float().argmax(-1) + 1, 0)
    return take_spans(readings, steps)


@torch.no_grad()
def filtered(model: Filter, readings: Sequence[TensorDict], draws: int = 1, seed: int = 0) -> list[TensorDict]:
    """Beliefs on readings ``[N]`` each, ``[draws, N]``, from the true pose on; those of one length run side by side."""
    groups: dict[int, list[int]] = defaultdict(list)
    for place, reading in enumerate(readings):
        groups[len(reading)].append(place)
    out: dict[int, TensorDict] = {}
    for places in groups.values():
        rows = []
        for place in places:
            row = readings[place].copy()
            row["start"] = row["state"].clone()
            row["start"][0] = first_state(row)
            rows.append(mark_start(row))
        keys = set.intersection(*(set(row.keys(True, True)) for row in rows))
        batch = TensorDict.stack([row.select(*keys) for row in rows for _ in range(draws)])
        torch.manual_seed(seed)
        beliefs = model.sequence(batch).unflatten(0, (len(places), draws))
        out.update(zip(places, beliefs, strict=True))
    return [out[place] for place in range(len(readings))]


def car_filter() -> tuple[CarFilter, Filter]:
    """The trained filter, and the same behind its sensor."""
    car = from_pretrained("car-odometry")
    assert isinstance(car, CarFilter)
    return car, car.without_sensor()
