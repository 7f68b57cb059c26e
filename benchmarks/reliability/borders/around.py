"""Constructors around filters: transforms, losses, environments, a car's filter and its readings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from benchmarks.reliability.borders import kitti, pretrained
from benchmarks.reliability.borders.subjects import Subject, cases_of
from benchmarks.reliability.case import Case
from benchmarks.reliability.damage import (
    CHOICE,
    COUNT,
    FINITE,
    LARGE_COUNT,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    angles,
    dims,
    matrix,
    vector,
)
from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.particle_for_tests import bootstrap
from torch_denkf import envs, objectives, odometry, transforms, vision
from torch_denkf.data import Episode, EpisodeReplay, bridge_gaps
from torch_denkf.functional import sigma_points, unscented_moments, unscented_weights
from torch_denkf.simulation.lorenz96 import lorenz96_step

NAN = float("nan")
SIZE = {"zero": (0, 10), "negative": (-4, 10), "one number": (10,), "text": "ab"}


def _pictures(transform: Any) -> Any:
    return transform(TensorDict({"pixels": torch.rand(2, 3, 12, 12)}, [2]))


def _transforms() -> list[Subject]:
    t = transforms
    bounds = {
        "upside down": (2.0, 1.0),
        "nan": (NAN, 1.0),
        "inf": (0.0, float("inf")),
        "one number": (1.0,),
        "text": "ab",
    }
    shares = {"beyond one": (1.5, 0.5), "negative": (-0.5, 0.5), "nan": (NAN, 0.5), "one number": (0.5,), "text": "ab"}
    return [
        Subject("MissingFrames", t.MissingFrames, dict, {"p": SHARE}, _pictures),
        Subject("BlackFrames", t.BlackFrames, dict, {"p": SHARE}, _pictures),
        Subject(
            "Blur",
            t.Blur,
            dict,
            {
                "p": SHARE,
                "kernel": {
                    "even": 4,
                    "negative": -3,
                    "zero": 0,
                    "a fraction": 2.5,
                    "three numbers": (3, 3, 3),
                    "text": "wide",
                },
            },
            _pictures,
        ),
        Subject(
            "Brightness",
            t.Brightness,
            dict,
            {"p": SHARE, "gain": {**bounds, "negative": (-1.0, 1.0)}, "offset": bounds},
            _pictures,
        ),
        Subject("OccludingBox", t.OccludingBox, dict, {"p": SHARE, "size": shares, "position": shares}, _pictures),
        Subject(
            "SaltAndPepper",
            t.SaltAndPepper,
            dict,
            {"p": SHARE, "fraction": {"negative": -0.1, "beyond a half": 0.7, "nan": NAN, "text": "x"}},
            _pictures,
        ),
        Subject(
            "OpticalFlow",
            t.OpticalFlow,
            lambda: {"calibration": (40.0, 40.0, 35.0, 11.0)},
            {
                "calibration": {
                    "three numbers": (1.0, 1.0, 1.0),
                    "zero": (0.0, 40.0, 35.0, 11.0),
                    "negative": (-4.0, 40.0, 35.0, 11.0),
                    "nan": (NAN, 40.0, 35.0, 11.0),
                    "text": "ab",
                },
                "height": POSITIVE,
            },
            lambda made: made(TensorDict({"pixels": torch.rand(6, 24, 72)})),
        ),
    ]


def _batch(loss: Any) -> Any:
    torch.manual_seed(0)
    frames = TensorDict({"observation": torch.randn(3, 5, 2), "state": torch.randn(3, 5, 2)}, [3, 5])
    return loss(frames)


def _losses() -> list[Subject]:
    o = objectives
    weight = {"negative": -1.0, "nan": NAN, "inf": float("inf"), "text": "x"}
    scale = {**vector(2, positive=True), "inf": [float("inf")] * 2}
    common = {"score": CHOICE, "state_scale": scale, "reduction": CHOICE, "angles": angles(2)}
    ensemble = lambda: {"filter": linear_denkf("etkf"), "sensor": 0.0}  # noqa: E731
    gaussian = lambda: {"filter": linear_kalman()}  # noqa: E731
    particles = lambda: {"filter": bootstrap(8, resampling="soft")}  # noqa: E731
    filter_ = {"nothing": None, "text": "x", "no filter": torch.nn.Linear(2, 2)}
    return [
        Subject(
            "DEnKFLoss",
            o.DEnKFLoss,
            ensemble,
            {**common, "filter": filter_, **dict.fromkeys(("state", "transition", "observation", "nll", "kl"), weight)},
            _batch,
        ),
        Subject(
            "GaussianLoss",
            o.GaussianLoss,
            gaussian,
            {**common, "filter": filter_, **dict.fromkeys(("state", "transition", "nll"), weight), "dims": dims(2)},
            _batch,
        ),
        Subject(
            "MixtureLoss",
            o.MixtureLoss,
            particles,
            {
                **common,
                "filter": filter_,
                "component_std": POSITIVE,
                **dict.fromkeys(("state", "transition", "mean", "nll"), weight),
            },
            _batch,
        ),
        Subject(
            "TransitionLoss",
            o.TransitionLoss,
            lambda: {"filter": linear_denkf("etkf")},
            {**common, "spread": NOT_NEGATIVE, "members": LARGE_COUNT},
            _batch,
        ),
    ]


@cache
def _rows() -> EpisodeReplay:
    step = torch.arange(10).repeat(2).unsqueeze(-1)
    rows = TensorDict({"step": step, "time": step * 0.1, "state": torch.rand(20, 2)}, [20])
    return EpisodeReplay(rows, [Episode("a", 0, 10), Episode("b", 10, 10)], for_tests=lambda episode: False)


def _linear() -> dict[str, Any]:
    eye = torch.eye(2)
    return {
        "transition": 0.9 * eye,
        "observation": eye.clone(),
        "transition_std": [0.1, 0.1],
        "observation_std": [0.1, 0.1],
    }


def _environments() -> list[Subject]:
    roll = lambda env: env.rollout(3)  # noqa: E731
    std = vector(2, negative=False)
    stretches = {
        "start": {"negative": -1, "beyond": 100, "unknown": "somewhere", "a fraction": 1.5},
        "length": {"one": 1, "negative": -1, "beyond": 100, "text": "x"},
    }
    batch = {"negative": [-1], "text": "x", "a fraction": [1.5]}
    return [
        Subject(
            "ReplayEnv",
            envs.ReplayEnv,
            lambda: {"data": _rows()},
            {
                "data": {"nothing": None, "text": "x"},
                "episodes": {"unknown": "z", "beyond": 7, "none": []},
                "batch_size": batch,
                **stretches,
            },
            roll,
        ),
        Subject(
            "KITTIReplayEnv",
            envs.KITTIReplayEnv,
            lambda: {"drive": kitti.reference()},
            {**stretches, "batch_size": batch},
            roll,
        ),
        Subject(
            "LinearGaussianEnv",
            envs.LinearGaussianEnv,
            _linear,
            {
                "transition": matrix(2, 2),
                "observation": {k: v for k, v in matrix(2, 2).items() if k not in ("a row more", "three dimensions")},
                "transition_std": std,
                "observation_std": std,
                "initial_std": std,
                "missing": SHARE,
                "max_steps": COUNT,
                "control": {k: v for k, v in matrix(2, 1).items() if k not in ("a column more", "three dimensions")},
                "batch_size": batch,
            },
            roll,
        ),
    ]


def _tracked(**given: Any) -> Any:
    car = pretrained.LOADERS["car-odometry"](pretrained.FOLDERS / "car-odometry")
    frames = [np.full((24, 72, 3), 40 * k, np.uint8) for k in range(4)]
    settings: dict[str, Any] = {"frames": frames, "calibration": (41.7, 41.7, 35.5, 11.5), "fps": 10.0, **given}
    if "times" in given:
        settings["fps"] = None
    return list(odometry.track(car, **settings))


def _no_moments(points: torch.Tensor) -> bool:
    """What functions of tensors promise where an element of a batch has no result: that it is NaN, and no other one.

    They look at no values, which under ``torch.compile`` and on a GPU would cost more than they do. Of sigma points
    without a covariance nothing finite may be left in their moments.
    """
    moments = unscented_moments(points, unscented_weights(2))
    sound = sigma_points(torch.zeros(2), torch.eye(2))
    return all(bool(value[1].isnan().all()) for value in moments) and torch.equal(points[0], sound)


def _car() -> list[Subject]:
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
    settings = {
        "dt": POSITIVE,
        "ensemble_size": LARGE_COUNT,
        "velocity_std": vector(2, positive=True),
        "velocity_mean": vector(2),
        "lags": COUNT,
        "longest": COUNT,
        "reach": POSITIVE,
        "features": COUNT,
        "size": SIZE,
        "focal": POSITIVE,
        "inflation": POSITIVE,
        "colour": {"no such setting": "red"},
    }
    path = lambda: {"path": torch.zeros(3, 5)}  # noqa: E731,F841
    return [
        Subject("car_filter", odometry.car_filter, dict, settings),
        Subject(
            "track",
            _tracked,
            dict,
            {
                "frames": frames,
                "times": times,
                "fps": POSITIVE,
                "height": POSITIVE,
                "pitch": {**FINITE, "a right angle": 1.57},
                "black_level": {"negative": -1, "beyond": 300, "text": "x"},
                "calibration": {
                    "three numbers": (1.0, 1.0, 1.0),
                    "zero": (0.0, 40.0, 35.0, 11.0),
                    "nan": (NAN, 40.0, 35.0, 11.0),
                    "text": "abcd",
                },
            },
            also={"frames": ("frame",), "times": ("time",)},
        ),
        Subject("CanonicalCamera", vision.CanonicalCamera, lambda: {"focal": 40.0}, {"focal": POSITIVE}),
        Subject(
            "Updates",
            odometry.Updates,
            dict,
            {"sensor": COUNT, "filter": COUNT, "end_to_end": COUNT, "length": COUNT},
            also=dict.fromkeys(("sensor", "filter", "end_to_end", "length"), ("Updates",)),
        ),
        Subject("bridge_gaps", bridge_gaps, lambda: {"drive": kitti.reference()}, {"longest": COUNT}),
        Subject(
            "sigma_points",
            sigma_points,
            lambda: {"mean": torch.zeros(2, 2), "cov": torch.eye(2).expand(2, 2, 2)},
            {
                "cov": {
                    "negative": torch.stack([torch.eye(2), -torch.eye(2)]),
                    "indefinite": torch.stack([torch.eye(2), torch.tensor([[1.0, 2.0], [2.0, 1.0]])]),
                    "nan": torch.stack([torch.eye(2), torch.full((2, 2), NAN)]),
                    "a row more": torch.eye(3, 2).expand(2, 3, 2),
                },
                "alpha": {"zero": 0.0, "nan": NAN},
                "kappa": {"minus the dimension": -2.0, "nan": NAN},
            },
            right={"cov": _no_moments},
        ),
        Subject(
            "lorenz96_step",
            lorenz96_step,
            lambda: {"state": torch.zeros(5)},
            {"dt": POSITIVE, "state": {"three numbers": torch.zeros(3)}},
        ),
    ]


def cases() -> Iterator[Case]:
    """All damaged arguments."""
    yield from cases_of("transforms", _transforms())
    yield from cases_of("losses", _losses())
    yield from cases_of("environments", _environments())
    yield from cases_of("car", _car())
