"""A frozen sensor's readings of whole streams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDict

from benchmarks.kitti.folds import Part
from benchmarks.kitti.streams import LONGEST, mirror, rows, spans
from torch_denkf.applications.car.kitti.frames import MOTION_KEYS
from torch_denkf.modules import SubModel


@torch.no_grad()
def read_sensor(sensor: SubModel, data: TensorDict, kind: str, mirrored: bool = False, chunk: int = 256) -> TensorDict:
    """A sensor's readings of a whole stream ``[N]``, from the same random numbers each time."""
    readings = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        was_training = sensor.training
        sensor.eval()
        for index in torch.arange(len(data)).split(chunk):
            frames = rows(data, index, kind)
            readings.append(sensor(mirror(frames) if mirrored else frames).exclude(*MOTION_KEYS, "pixels"))
        sensor.train(was_training)
    return torch.cat(readings)


def read_spans(sensor: SubModel, part: Part, cache: Path, kind: str, mirrored: bool = False) -> TensorDict:
    """A sensor's readings of a part ``[N]``, of pairs of 1, 2, ... steps: ``("spans", ...)`` ``[N, LONGEST]``.

    Those that were not computed are not observed.
    """
    parts = [replace(part, stream=stream) for stream in spans(part.stream, kind)]
    read = [read_sensor(sensor, each.read(cache), kind, mirrored) for each in parts]
    entries = {
        "observed": [each["observed"] for each in read],
        "ensemble": [each["sensor", "ensemble"] for each in read],
        "encoding": [each["sensor", "encoding"] for each in read],
    }
    blank = LONGEST - len(read)
    stacked = {
        key: torch.stack([*values, *[torch.zeros_like(values[0])] * blank], 1) for key, values in entries.items()
    }
    size = (len(read[0]), LONGEST)
    return TensorDict({"state": read[0]["state"], "spans": TensorDict(stacked, batch_size=size)}, batch_size=size[:1])
