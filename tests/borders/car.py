"""Arguments of the car's filter, its cameras and its training."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import NAN
from benchmarks.reliability.target import Subject, Target, targets_of
from tests.borders import models
from tests.borders.around_filters import STRETCHES
from tests.borders.kitti import drive
from torch_denkf.applications.car import KITTIReplayEnv, OpticalFlow, track
from torch_denkf.applications.car.kitti.gaps import bridge_gaps
from torch_denkf.applications.car.odometry.filter import car_filter
from torch_denkf.applications.car.odometry.training import Updates
from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.functional import sigma_points
from torch_denkf.functional.unscented import unscented_moments, unscented_weights

CALIBRATION = d.of((1.0, 1.0, 1.0), (0.0, 40.0, 35.0, 11.0), (NAN, 40.0, 35.0, 11.0), (-4.0, 40.0, 35.0, 11.0), "ab")
#: Of pictures of another size.
FAR = (718.0, 718.0, 607.0, 185.0)
PICTURES = [*np.random.default_rng(0).integers(0, 256, (4, 24, 72, 3), np.uint8)]


def _tracked(**given: Any) -> Any:
    car = models.LOADERS["car-odometry"](models.FOLDERS["car-odometry"])
    settings: dict[str, Any] = {"frames": PICTURES, "calibration": (41.7, 41.7, 35.5, 11.5), "fps": 10.0, **given}
    if "times" in given:
        settings["fps"] = None
    return list(track(car, **settings))


def _no_moments(points: torch.Tensor) -> bool:
    """Checks what functions of tensors promise where an element of a batch has no result: that it alone is NaN.

    They look at no values, which under ``torch.compile`` and on a GPU would cost more than they do. Of sigma points
    without a covariance nothing finite may be left in their moments.
    """
    moments = unscented_moments(points, unscented_weights(2))
    sound = sigma_points(torch.zeros(2), torch.eye(2))
    return all(bool(value[1].isnan().all()) for value in moments) and torch.equal(points[0], sound)


def _arguments() -> Iterator[Subject]:
    eye, frame = torch.eye(2), PICTURES[0]
    frames = {
        "none": [],
        "one": [frame],
        "one that is seen": [frame, None],
        "another size": [frame, frame[:10], frame],
        "floats": [frame / 255.0] * 3,
        "five channels": [np.zeros((24, 72, 5), np.uint8)] * 3,
        "text": ["a", "b", "c"],
    }
    tracked = {
        "frames": d.Wrong(frames),
        "times": d.of([3.0, 2.0, 1.0, 0.0], [0.0] * 4, [0.0, NAN, 0.2, 0.3], [0.0, 0.1], ["a", "b", "c", "d"])
        | {"a gap of a day": [0.0, 0.1, 86400.0, 86400.1]},
        "fps": d.POSITIVE,
        "height": d.POSITIVE | {"in cm": 165},
        "pitch": d.FINITE | {"a right angle": 1.57, "degrees": 2.0},
        "black_level": d.of(-1, 300, "x"),
        "calibration": CALIBRATION | d.of(FAR),
    }
    covariances = {
        "negative": torch.stack([eye, -eye]),
        "indefinite": torch.stack([eye, torch.tensor([[1.0, 2.0], [2.0, 1.0]])]),
        "nan": torch.stack([eye, torch.full((2, 2), NAN)]),
        "a row more": torch.eye(3, 2).expand(2, 3, 2),
    }
    points = {"cov": d.Wrong(covariances), "mean": None, "alpha": d.of(0.0, NAN), "kappa": d.of(-2.0, NAN)}
    updates = dict.fromkeys(("sensor", "filter", "end_to_end", "length"), d.COUNT)
    flow = lambda transform: transform(TensorDict({"pixels": torch.rand(6, 24, 72)}))  # noqa: E731
    camera = lambda: {"calibration": (40.0, 40.0, 35.0, 11.0)}  # noqa: E731
    batch = lambda: {"mean": torch.zeros(2, 2), "cov": eye.expand(2, 2, 2)}  # noqa: E731
    yield Subject(car_filter, wrong=models.CAR)
    yield Subject(
        _tracked,
        wrong=tracked,
        also={"frames": ("frame",), "times": ("time",), "calibration": ("principal point",)},
        name="track",
    )
    yield Subject(CanonicalCamera, lambda: {"focal": 40.0})
    yield Subject(OpticalFlow, camera, flow, {"calibration": CALIBRATION})
    yield Subject(Updates, wrong=updates, also=dict.fromkeys(updates, ("Updates",)))
    yield Subject(bridge_gaps, lambda: {"drive": drive()})
    yield Subject(sigma_points, batch, wrong=points, right={"cov": _no_moments})
    roll = lambda env: env.rollout(3)  # noqa: E731
    yield Subject(KITTIReplayEnv, lambda: {"drive": drive()}, roll, {**STRETCHES, "size": None})


def targets() -> Iterator[Target]:
    """Yields all arguments."""
    yield from targets_of("car", *_arguments())
