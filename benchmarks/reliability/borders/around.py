"""Constructors around filters: transforms, losses, environments, a car's filter and its readings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders import kitti, pretrained
from benchmarks.reliability.target import Subject, Target, targets_of
from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.particle_for_tests import bootstrap
from torch_denkf import envs, objectives
from torch_denkf.applications.car import KITTIReplayEnv, OpticalFlow, track
from torch_denkf.applications.car.kitti.gaps import bridge_gaps
from torch_denkf.applications.car.odometry.filter import car_filter
from torch_denkf.applications.car.odometry.training import Updates
from torch_denkf.applications.car.vision.camera import CanonicalCamera
from torch_denkf.data import Episode, EpisodeReplay
from torch_denkf.functional import sigma_points
from torch_denkf.functional.unscented import unscented_moments, unscented_weights

NAN, INF = float("nan"), float("inf")
CALIBRATION = d.of((1.0, 1.0, 1.0), (0.0, 40.0, 35.0, 11.0), (NAN, 40.0, 35.0, 11.0), "ab")
NO_FILTER = d.Wrong({"nothing": None, "text": "x", "no filter": torch.nn.Linear(2, 2)})


def _pictures(transform: Any) -> Any:
    return transform(TensorDict({"pixels": torch.rand(2, 3, 12, 12)}, [2]))


def _flow(transform: Any) -> Any:
    return transform(TensorDict({"pixels": torch.rand(6, 24, 72)}))


def _transforms() -> Iterator[Subject]:
    bounds = d.of((2.0, 1.0), (NAN, 1.0), (0.0, INF), (1.0,), "ab")
    shares = d.of((1.5, 0.5), (-0.5, 0.5), (NAN, 0.5), (0.5,), "ab")
    kernel = d.COUNT | {"even": 4, "three numbers": (3, 3, 3)}
    fraction = d.of(-0.1, 0.7, NAN, "x")
    camera = lambda: {"calibration": (40.0, 40.0, 35.0, 11.0)}  # noqa: E731
    calibration = CALIBRATION | {"negative": (-4.0, 40.0, 35.0, 11.0)}
    yield Subject(envs.MissingFrames, use=_pictures)
    yield Subject(envs.BlackFrames, use=_pictures)
    yield Subject(envs.Blur, use=_pictures, wrong={"kernel": kernel})
    yield Subject(envs.Brightness, use=_pictures, wrong={"gain": bounds | {"negative": (-1.0, 1.0)}, "offset": bounds})
    yield Subject(envs.OccludingBox, use=_pictures, wrong={"size": shares, "position": shares})
    yield Subject(envs.SaltAndPepper, use=_pictures, wrong={"fraction": fraction})
    yield Subject(OpticalFlow, camera, _flow, {"calibration": calibration})


def _batch(loss: Any) -> Any:
    torch.manual_seed(0)
    frames = TensorDict({"observation": torch.randn(3, 5, 2), "state": torch.randn(3, 5, 2)}, [3, 5])
    return loss(frames)


def _losses() -> Iterator[Subject]:
    scale = d.vector(2, positive=True) | {"inf": [INF] * 2}
    common = {"filter": NO_FILTER, "state_scale": scale}
    weights = lambda *names: dict.fromkeys(names, d.NOT_NEGATIVE)  # noqa: E731
    denkf = weights("state", "transition", "observation", "nll", "kl")
    gaussian = {**weights("state", "transition", "nll"), "dims": d.dims(2)}
    mixture = {**weights("state", "transition", "mean", "nll"), "component_std": d.POSITIVE}
    transition = {"state_scale": scale, "spread": d.NOT_NEGATIVE, "members": d.LARGE_COUNT}
    ensemble = lambda: {"filter": linear_denkf("etkf")}  # noqa: E731
    particles = lambda: {"filter": bootstrap(8, resampling="soft")}  # noqa: E731
    yield Subject(objectives.DEnKFLoss, lambda: {**ensemble(), "sensor": 0.0}, _batch, {**common, **denkf})
    yield Subject(objectives.GaussianLoss, lambda: {"filter": linear_kalman()}, _batch, {**common, **gaussian})
    yield Subject(objectives.MixtureLoss, particles, _batch, {**common, **mixture})
    yield Subject(objectives.TransitionLoss, ensemble, _batch, transition)


@cache
def _rows() -> EpisodeReplay:
    step = torch.arange(10).repeat(2).unsqueeze(-1)
    rows = TensorDict({"step": step, "time": step * 0.1, "state": torch.rand(20, 2)}, [20])
    return EpisodeReplay(rows, [Episode("a", 0, 10), Episode("b", 10, 10)], for_tests=lambda episode: False)


def _linear() -> dict[str, Any]:
    eye, std = torch.eye(2), [0.1, 0.1]
    return {"transition": 0.9 * eye, "observation": eye, "transition_std": std, "observation_std": std}


def _environments() -> Iterator[Subject]:
    roll = lambda env: env.rollout(3)  # noqa: E731
    stretches = {
        "start": d.of(-1, 100, "somewhere", 1.5),
        "length": d.of(1, -1, 100, "x"),
        "batch_size": d.of([-1], "x", [1.5]),
    }
    data = {
        "data": d.of(None, "x"),
        "episodes": d.of("z", 7, []),
    }
    linear = {
        "transition": d.matrix(2, 2),
        "observation": d.matrix(2, 2).but("a row more", "three dimensions"),
        **dict.fromkeys(("transition_std", "observation_std", "initial_std"), d.vector(2, negative=False)),
        "missing": d.SHARE,
        "max_steps": d.COUNT,
        "control": d.matrix(2, 1).but("a column more", "three dimensions"),
        "batch_size": stretches["batch_size"],
    }
    yield Subject(envs.ReplayEnv, lambda: {"data": _rows()}, roll, {**data, **stretches})
    yield Subject(KITTIReplayEnv, lambda: {"drive": kitti.DRIVES.reference()}, roll, {**stretches, "size": None})
    yield Subject(envs.LinearGaussianEnv, _linear, roll, linear)


def _tracked(**given: Any) -> Any:
    car = pretrained.LOADERS["car-odometry"](pretrained.FOLDERS["car-odometry"])
    frames = [np.full((24, 72, 3), 40 * k, np.uint8) for k in range(1, 5)]
    settings: dict[str, Any] = {"frames": frames, "calibration": (41.7, 41.7, 35.5, 11.5), "fps": 10.0, **given}
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


def _track() -> dict[str, d.Wrong]:
    frame = np.zeros((24, 72, 3), np.uint8)
    frames = {
        "none": [],
        "one": [frame],
        "another size": [frame, frame[:10], frame],
        "floats": [frame / 255.0] * 3,
        "five channels": [np.zeros((24, 72, 5), np.uint8)] * 3,
        "text": ["a", "b", "c"],
    }
    times = {
        "backwards": [3.0, 2.0, 1.0, 0.0],
        "the same": [0.0] * 4,
        "nan": [0.0, NAN, 0.2, 0.3],
        "too few": [0.0, 0.1],
        "text": ["a", "b", "c", "d"],
        "a gap of a day": [0.0, 0.1, 86400.0, 86400.1],
    }
    return {
        "frames": d.Wrong(frames),
        "times": d.Wrong(times),
        "fps": d.POSITIVE,
        "height": d.POSITIVE,
        "pitch": d.FINITE | {"a right angle": 1.57},
        "black_level": d.of(-1, 300, "x"),
        "calibration": CALIBRATION,
    }


def _car() -> Iterator[Subject]:
    eye = torch.eye(2)
    covariances = {
        "negative": torch.stack([eye, -eye]),
        "indefinite": torch.stack([eye, torch.tensor([[1.0, 2.0], [2.0, 1.0]])]),
        "nan": torch.stack([eye, torch.full((2, 2), NAN)]),
        "a row more": torch.eye(3, 2).expand(2, 3, 2),
    }
    points = {
        "cov": d.Wrong(covariances),
        "mean": None,
        "alpha": d.of(0.0, NAN),
        "kappa": d.of(-2.0, NAN),
    }
    updates = dict.fromkeys(("sensor", "filter", "end_to_end", "length"), d.COUNT)
    named = dict.fromkeys(updates, ("Updates",))
    batch = lambda: {"mean": torch.zeros(2, 2), "cov": eye.expand(2, 2, 2)}  # noqa: E731
    yield Subject(car_filter, wrong=pretrained.CAR)
    yield Subject(_tracked, wrong=_track(), also={"frames": ("frame",), "times": ("time",)}, name="track")
    yield Subject(CanonicalCamera, lambda: {"focal": 40.0})
    yield Subject(Updates, wrong=updates, also=named)
    yield Subject(bridge_gaps, lambda: {"drive": kitti.DRIVES.reference()})
    yield Subject(sigma_points, batch, wrong=points, right={"cov": _no_moments})


def targets() -> Iterator[Target]:
    """All arguments."""
    yield from targets_of("transforms", *_transforms())
    yield from targets_of("losses", *_losses())
    yield from targets_of("environments", *_environments())
    yield from targets_of("car", *_car())
