"""A frozen sensor's readings of whole streams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tensordict import TensorDict

from benchmarks.kitti.folds import Part
from benchmarks.kitti.streams import LONGEST, read_by, spans
from torch_denkf.applications.car.odometry import streams
from torch_denkf.modules import SubModel


def read_sensor(sensor: SubModel, data: TensorDict, kind: str) -> TensorDict:
    """A sensor's readings of a whole stream ``[N]``, from the same random numbers each time."""
    return streams.read_sensor(sensor, read_by(kind, data), LONGEST).exclude("pixels")


def read_spans(sensor: SubModel, part: Part, cache: Path, kind: str, mirrored: bool = False) -> TensorDict:
    """A sensor's readings of a part ``[N]``, of pairs of 1, 2, ... steps: ``("spans", ...)`` ``[N, LONGEST]``.

    Those that were not computed are not observed.
    """
    parts = [replace(part, stream=stream) for stream in spans(part.stream, kind)]
    data = [read_by(kind, each.read(cache)) for each in parts]
    return streams.read_spans(sensor, data, LONGEST, mirrored=mirrored)
