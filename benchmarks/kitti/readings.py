"""Runs a frozen sensor on whole streams."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from tensordict import TensorDict

from benchmarks.kitti.folds import Part
from benchmarks.kitti.streams import LONGEST, read_by, spans
from torch_denkf.applications.car.odometry import streams
from torch_denkf.modules import SubModel


def read_sensor(sensor: SubModel, data: TensorDict, kind: str) -> TensorDict:
    """Returns a sensor's readings of a whole stream ``[N]``, with a fixed seed."""
    return streams.read_sensor(sensor, read_by(kind, data), LONGEST).exclude("pixels")


def read_spans(sensor: SubModel, part: Part, cache: Path, kind: str, mirrored: bool = False) -> TensorDict:
    """Returns a sensor's readings of a part ``[N]`` for frame pairs 1, 2, ... steps apart.

    They are ``("spans", ...)`` ``[N, LONGEST]``. The observed mask is False for pairs that were not computed.
    """
    parts = [replace(part, stream=stream) for stream in spans(part.stream, kind)]
    data = [read_by(kind, each.read(cache)) for each in parts]
    return streams.read_spans(sensor, data, LONGEST, mirrored=mirrored)
