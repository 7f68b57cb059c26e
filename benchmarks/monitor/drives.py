"""Readings of the trained sensor on drives whose camera fails silently."""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.applications.car import read_kitti_drive, with_motion
from torch_denkf.applications.car.odometry.batches import mark_start
from torch_denkf.applications.car.odometry.filter import CarFilter
from torch_denkf.applications.car.odometry.scores import first_state
from torch_denkf.applications.car.odometry.streams import read_sensor, shortest_spans
from torch_denkf.applications.car.vision.poses import KITTI_DT
from torch_denkf.applications.car.vision.signs import (
    FLOW_SIGNS,
    PICTURE_SIGNS,
    flow_signs,
    picture_signs,
    plane_distance,
)
from torch_denkf.data.cache import cached
from torch_denkf.envs import BlackFrames, Brightness, OccludingBox
from torch_denkf.filters import Filter
from torch_denkf.pretrained import from_pretrained

LENGTH, PERIOD = 20, 60  # frames of a fault, and between the beginnings of two faults
SIGNS = (*PICTURE_SIGNS, *FLOW_SIGNS)
_IMAGE = {"in_keys": ("image",)}
#: Faults of the images in some stretches of a drive.
FAULTS: dict[str, Callable] = {
    "black": partial(BlackFrames, 1.0, **_IMAGE),
    "box": partial(OccludingBox, **_IMAGE),
    "exposure": partial(Brightness, (6.0, 6.0), (0.1, 0.1), **_IMAGE),  # most of the street is white
}
#: Faults over a whole drive: three frames in ten are black, or a box covers 5 % of each.
ALWAYS: dict[str, Callable] = {
    "black-all": partial(BlackFrames, 0.3, **_IMAGE),
    "box-all": partial(OccludingBox, **_IMAGE),
}


def stretches(frames: int) -> Tensor:
    """Returns the mask of the frames with a fault, ``[frames]``."""
    number = torch.arange(frames)
    return (number % PERIOD >= PERIOD - LENGTH) & (number < frames // PERIOD * PERIOD)


def failing(root: Path, name: str, fault: str, cache: Path, steps: int = 1, *, repair: bool = False) -> TensorDict:
    """Returns the trained sensor's readings of a whole drive ``[N]``.

    ``"fault"`` ``[N, 1]`` masks the pairs of images with the fault; ``"signs"`` ``[N, 6]`` are those of ``SIGNS``.
    The last two, of the flow, are NaN for unrepaired pairs with the fault, and for pairs of more than one step.

    Args:
        root: folder in KITTI's layout.
        name: of the drive.
        fault: ``"clean"``, or of ``FAULTS`` or ``ALWAYS``.
        cache: folder in which readings are cached.
        steps: between the two images of a pair.
        repair: whether the flow is extrapolated over static regions of the images.
    """
    entry = f"{name}-{fault}" if steps == 1 else f"{name}-{fault}-{steps}"
    # Pairs without a fault are copied from the clean drive, and pairs without a repair from the plain reading.
    clean = failing(root, name, "clean", cache) if fault != "clean" and steps == 1 else None
    plain = cached(cache / entry, lambda: _read(root, name, fault, steps, clean, cache)).copy()
    shown = cached(cache / f"{entry}-signs", lambda: _picture_signs(root, name, fault, steps))["signs"]
    if steps > 1:
        seen = torch.full((len(plain), 2), torch.nan)
    elif clean is None:
        seen = cached(cache / f"{entry}-plane", lambda: _by_flow(root, name, fault, None, cache))["by_flow"]
    else:
        seen = torch.where(plain["fault"], torch.nan, clean["by_flow"])
    plain = _with_signs(plain, shown, seen)
    if not repair or not shown[:, SIGNS.index("static")].any():
        return plain
    out = cached(cache / f"{entry}-repaired", lambda: _read(root, name, fault, steps, plain, cache, repair=True)).copy()
    if steps == 1:
        made = cached(cache / f"{entry}-repaired-plane", lambda: _by_flow(root, name, fault, plain, cache))["by_flow"]
        seen = torch.where(made.isnan(), seen, made)
    return _with_signs(out, shown, seen)


def _with_signs(reading: TensorDict, shown: Tensor, seen: Tensor) -> TensorDict:
    """Returns the reading with all signs, given distance and road correlation by the flow ``[N, 2]``."""
    distance = reading["sensor", "ensemble"][..., 0].mean(-1) * KITTI_DT
    of_flow = flow_signs(seen[:, 0], seen[:, 1].reshape(-1, 1, 1), distance)
    return reading.update({"signs": torch.cat([shown, of_flow], -1), "by_flow": seen, "plane": seen[:, :1]})


def _drive(root: Path, name: str, fault: str, steps: int) -> TensorDict:
    """Returns the drive with its fault: ``"steps"`` ``[N, 1]`` of each frame pair, a mask ``"fault"`` ``[N, 1]``."""
    size = from_pretrained("car-odometry").settings.size
    drive = read_kitti_drive(root, name, size=size, colour=False, cache=None).copy()
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
    pair = hit | torch.cat([torch.zeros(steps, dtype=torch.bool), hit[:-steps]])
    return drive.set("fault", pair.unsqueeze(-1))


def _picture_signs(root: Path, name: str, fault: str, steps: int) -> TensorDict:
    """Returns the image signs of a failing camera ``[N, 4]``."""
    drive = _drive(root, name, fault, steps)
    images, out = drive["image"][:, 0].numpy(), torch.zeros(len(drive), len(PICTURE_SIGNS))
    for row in drive["steps"].squeeze(-1).nonzero().flatten().tolist():
        out[row] = torch.from_numpy(picture_signs(images[row - steps], images[row]))
    return TensorDict({"signs": out}, [len(drive)])


def _by_flow(root: Path, name: str, fault: str, known: TensorDict | None, cache: Path) -> TensorDict:
    """Returns distance by the flow and road correlation, ``[N, 2]``, after the repair if one is possible."""
    motion = _motion(root, name, fault, 1, known, cache, repair=known is not None)
    values = torch.stack([plane_distance(motion["flow"].float()), motion["road"].float().amax((1, 2))], -1)
    return TensorDict({"by_flow": torch.where(motion["steps"] > 0, values, torch.nan)}, [len(motion)])


def _motion(
    root: Path, name: str, fault: str, steps: int, known: TensorDict | None, cache: Path, *, repair: bool
) -> TensorDict:
    """Returns flow and road of the pairs that are not in ``known``."""
    drive = _drive(root, name, fault, steps)
    if known is not None:
        static = known["signs"][:, [SIGNS.index("static")]] > 0
        drive["steps"] = drive["steps"] * (static if repair else drive["fault"])
    kept = cache / "flow" if repair or fault == "clean" else None  # the signs read it, too
    return with_motion(drive, cache=kept, keep_images=False, repair=repair)


def _read(
    root: Path, name: str, fault: str, steps: int, known: TensorDict | None, cache: Path, *, repair: bool = False
) -> TensorDict:
    """Returns the sensor's readings of a drive ``[N]``; readings of unaffected pairs are copied from ``known``."""
    car, motion = from_pretrained("car-odometry"), _motion(root, name, fault, steps, known, cache, repair=repair)
    out = read_sensor(car.sensor, motion, car.settings.longest).set("fault", motion["fault"])
    if known is None:
        return out
    old = known.select(*out.keys(True, True)).set("fault", out["fault"])
    return torch.where(motion["steps"].squeeze(-1) > 0, out, old)


def believed_spans(spans: Sequence[TensorDict], seen: Callable[[TensorDict], Tensor]) -> TensorDict:
    """Returns the readings ``[N]`` of the shortest observed pairs of 1, 2, ... steps.

    Args:
        spans: readings of the pairs, ``[N]`` each.
        seen: maps readings to their observed mask ``[N, 1]``.
    """
    values = {name: torch.stack([each["sensor", name] for each in spans], 1) for name in ("ensemble", "encoding")}
    values["observed"] = torch.stack([seen(each) for each in spans], 1)
    size = torch.Size([len(spans[0]), len(spans)])
    return shortest_spans(TensorDict({"state": spans[0]["state"], "spans": TensorDict(values, size)}, size[:1]))


def from_truth(reading: TensorDict) -> TensorDict:
    """Returns readings ``[N]`` that begin at the true pose."""
    row = reading.copy()
    row["start"] = row["state"].clone()
    row["start"][0] = first_state(row)
    return mark_start(row)


@torch.no_grad()
def filtered(model: Filter, readings: Sequence[TensorDict], draws: int = 1, seed: int = 0) -> list[TensorDict]:
    """Returns beliefs ``[draws, N]`` on each drive's readings ``[N]``, from the true first pose."""
    groups: dict[int, list[int]] = defaultdict(list)
    for place, reading in enumerate(readings):
        groups[len(reading)].append(place)
    out: dict[int, TensorDict] = {}
    for places in groups.values():
        rows = [from_truth(readings[place]) for place in places]
        keys = set.intersection(*(set(row.keys(True, True)) for row in rows))
        batch = TensorDict.stack([row.select(*keys) for row in rows for _ in range(draws)])
        torch.manual_seed(seed)
        beliefs = model.sequence(batch).unflatten(0, (len(places), draws))
        out.update(zip(places, beliefs, strict=True))
    return [out[place] for place in range(len(readings))]


def side_by_side(beliefs: Sequence[TensorDict]) -> list[TensorDict]:
    """Concatenates beliefs ``[K, N]`` of equal length to ``[K', N]``, so that a monitor runs over them in one batch."""
    groups: dict[int, list[TensorDict]] = defaultdict(list)
    for each in beliefs:
        groups[each.shape[1]].append(each)
    shared = [set.intersection(*(set(each.keys(True, True)) for each in group)) for group in groups.values()]
    return [
        torch.cat([each.select(*keys) for each in group]) for group, keys in zip(groups.values(), shared, strict=True)
    ]


def car_filter() -> tuple[CarFilter, Filter]:
    """Returns the trained filter, and the same filter without its sensor."""
    car = from_pretrained("car-odometry")
    assert isinstance(car, CarFilter)
    return car, car.without_sensor()
