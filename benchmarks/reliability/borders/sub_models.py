"""Constructors of sub-models."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders.filters_made import IMAGE_SHAPE, SIGMA
from benchmarks.reliability.target import Subject, Target, targets_of
from torch_denkf import modules as m
from torch_denkf.applications.car import FlowSensor, UnicycleMotion, UnicycleNoise, UnicycleTransition
from torch_denkf.applications.car.modules.member_gain import MemberGain
from torch_denkf.applications.car.modules.pairs import ClonedPrior, ClonedTransition, PairObservation, with_history
from torch_denkf.applications.car.modules.unicycle_pose import UnicyclePose
from torch_denkf.baselines.lstm_cell import LSTMUpdate, with_memory
from torch_denkf.modules.keypoints import SpatialSoftArgmax
from torch_denkf.modules.particles import ParticleAnalysis, ResampledTransition, with_weights
from torch_denkf.modules.stochastic import FlipoutLinear

EYE, NAN = torch.eye(2), float("nan")
BY_COLUMNS = d.matrix(2, 2).but("a row more")
STDS = d.vector(2, positive=True) | {"a matrix": torch.ones(2, 3)}
FLOOR = d.Wrong({"negative": -0.1, "nan": NAN, "beyond r": 5.0, "text": "much"})


def row(states: int = 2) -> TensorDict:
    """What a step of two readings may find."""
    made = TensorDict({"observation": torch.zeros(2), "action": torch.zeros(1), "state": torch.zeros(2)})
    for place in ("belief", "forecast", "sensor", "analysis"):
        made[place, "ensemble"] = torch.randn(8, 2 if place == "sensor" else states)
        made[place, "mean"], made[place, "cov"] = torch.zeros(states), torch.eye(states)
    made["forecast", "observation"], made["sensor", "noise"] = torch.randn(8, 2), torch.ones(2)
    made["belief", "log_weight"] = made["forecast", "log_weight"] = torch.full((8,), -2.0794415)
    made["sensor", "encoding"], made["measurement"] = torch.zeros(4), torch.zeros(4)
    made["pixels"] = torch.zeros(3, 24, 24)
    return made


def on_row(module: Any) -> Any:
    """Runs a sub-model as a filter does."""
    return module(row())


def on_car(module: Any) -> Any:
    """Likewise, of a car."""
    return module(row(5))


def on_likelihoods(module: Any) -> Any:
    """Likewise, behind a sub-model that weighs particles."""
    return module(row().set(("forecast", "log_likelihood"), torch.zeros(8)))


def on_vectors(network: Any) -> Any:
    """Runs a network of two features."""
    return network(torch.zeros(8, 2))


def on_images(network: Any) -> Any:
    """Runs a network of images."""
    return network(torch.zeros(2, 3, 24, 24))


def moments(size: int = 2) -> dict[str, Any]:
    """A mean and a covariance."""
    return {"mean": torch.zeros(size), "cov": torch.eye(size)}


def prior() -> dict[str, Any]:
    """A mean and standard deviations."""
    return {"mean": [0.0, 0.0], "std": [1.0, 1.0]}


def cloud() -> dict[str, Any]:
    """A prior of eight members, for those that add to one."""
    return {"initial": m.GaussianPrior(**prior(), ensemble_size=8)}


def noise() -> Any:
    """The noise of a motion."""
    return m.ConstantNoise([0.1, 0.1], in_key=("belief", "mean"), out_key=("forecast", "noise"))


def net() -> nn.Module:
    """The network of a motion."""
    return m.StochasticMLP(2, 2, (4,))


def motion() -> dict[str, Any]:
    """A motion, for those that add to one."""
    return {"transition": m.LearnedTransition(net())}


def _priors() -> Iterator[Subject]:
    memory = lambda: {"initial": m.MomentPrior(**moments()), "hidden_size": 4}  # noqa: E731
    cloned = lambda: {"initial": m.MomentPrior(**moments(5)), "lags": 2}  # noqa: E731
    covariance = {"cov": d.covariance(2)}
    yield Subject(m.GaussianPrior, prior, on_row)
    yield Subject(m.AroundState, lambda: {"std": [1.0, 1.0]}, on_row)
    yield Subject(m.FromSensor, lambda: {**prior(), "dims": [0, 1]}, on_row, {"dims": d.dims(2)})
    yield Subject(m.MomentPrior, moments, on_row, covariance, {"mean": ("cov",)})  # of two sizes, either may be wrong
    yield Subject(m.GaussianAround, lambda: {"std": [1.0, 1.0]}, on_row)
    yield Subject(with_memory, memory, on_row)
    yield Subject(with_history, lambda: {**cloud(), "lags": 2}, on_row)
    yield Subject(ClonedPrior, cloned, on_row)
    yield Subject(with_weights, cloud, on_row)


def _motions() -> Iterator[Subject]:
    linear = {"matrix": d.matrix(2, 2), "noise": d.covariance(2), "control": d.matrix(2, 1).but("a column more")}
    given = lambda: {"matrix": 0.9 * EYE, "noise": 0.1 * EYE, "control": torch.ones(2, 1)}  # noqa: E731
    noisy = lambda: {**motion(), "process_noise": noise()}  # noqa: E731
    module = {"process_noise": d.MODULE}
    yield Subject(m.LearnedTransition, lambda: {"network": net()}, on_row)
    yield Subject(UnicycleTransition, lambda: {"velocity": net(), "dt": 0.1}, on_car)
    yield Subject(UnicycleMotion, lambda: {"dt": 0.1}, on_car)
    yield Subject(UnicyclePose, lambda: {"dt": 0.1})
    yield Subject(m.LinearTransition, given, on_row, linear)
    yield Subject(m.EKFTransition, noisy, on_row, module)
    yield Subject(m.UKFTransition, noisy, on_row, {**SIGMA, **module})
    dims = lambda: {**motion(), "noise": noise(), "dims": [0, 1]}  # noqa: E731
    yield Subject(m.NoisyTransition, dims, on_row, {"dims": d.dims(2)})
    yield Subject(ResampledTransition, motion, on_row, {"alpha": d.SHARE})
    yield Subject(ClonedTransition, motion)


def _observations() -> Iterator[Subject]:
    reach = d.Wrong({"nan": [NAN], "negative": [-1.0], "zero": [0.0], "text": "far"})
    yield Subject(m.Select, lambda: {"dims": [0, 1]}, on_row, {"dims": d.indices(2)})
    yield Subject(m.LinearObservation, lambda: {"matrix": EYE.clone()}, on_row, {"matrix": BY_COLUMNS})
    yield Subject(m.LearnedObservation, lambda: {"network": nn.Linear(2, 2)}, on_row)
    yield Subject(PairObservation, lambda: {"reach": [1.0]}, wrong={"reach": reach})


def _noises() -> Iterator[Subject]:
    cholesky = {"r": STDS, "floor": FLOOR, "loc": None, "scale": None, "in_features": None, "num_cells": None}
    scaled = lambda: {"noise": m.ConstantNoise([0.5, 0.5]), "factor": 1.0}  # noqa: E731
    mapped = lambda: {"noise": noise(), "matrix": EYE.clone()}  # noqa: E731
    diagonal = {"r": STDS, "floor": FLOOR}
    yield Subject(m.DiagonalNoise, lambda: {"observation_dim": 2}, on_row, diagonal)
    yield Subject(m.ConstantNoise, lambda: {"r": [0.5, 0.5]}, on_row, {"r": STDS.but("too long", "a matrix", "zero")})
    yield Subject(m.CholeskyNoise, lambda: {"dim": 2}, on_row, cholesky)
    yield Subject(m.ScaledNoise, scaled, on_row)
    yield Subject(m.MappedNoise, mapped, on_row, {"matrix": BY_COLUMNS})
    yield Subject(UnicycleNoise, lambda: {"noise": noise(), "dt": 0.1}, on_car)


def _networks() -> Iterator[Subject]:
    features = lambda: {"in_features": 2, "out_features": 2}  # noqa: E731
    image = lambda: {"observation_dim": 2, "image_shape": (3, 24, 24), "ensemble_size": 4}  # noqa: E731
    vector = lambda: {"in_features": 4, "observation_dim": 2, "ensemble_size": 4}  # noqa: E731
    trunk = {"in_channels": 3, "channels": (8, 8), "keypoints": 4, "features": 8, "pooled": 2}
    images = {
        "ensemble_size": d.COUNT,
        "image_shape": IMAGE_SHAPE,
        "pixel_loc": d.vector(3),
        "pixel_scale": d.vector(3, positive=True),
    }
    readings = {"ensemble_size": d.COUNT, "loc": d.vector(4), "scale": d.vector(4, positive=True)}
    flow = {"dt": d.POSITIVE, "ensemble_size": d.COUNT, "trunk_dropout": d.SHARE | {"one": 1.0}}
    update = dict.fromkeys(("features", "observation_dim", "extra_features"), d.COUNT_OR_NONE)
    yield Subject(m.StochasticMLP, features, on_vectors, {"output_gain": d.FINITE})
    yield Subject(FlipoutLinear, features, on_vectors)
    yield Subject(m.ImageSensor, image, on_row, images)
    yield Subject(m.VectorSensor, vector, on_row, readings)
    yield Subject(FlowSensor, lambda: {"dt": 0.1}, wrong=flow)
    yield Subject(MemberGain, lambda: {"std": [0.1, 0.1], "ensemble_size": 8, "in_key": ("sensor", "ensemble")}, on_row)
    yield Subject(m.KeypointTrunk, lambda: trunk, on_images, {"channels": d.CELLS})
    yield Subject(SpatialSoftArgmax, lambda: {"channels": 3}, on_images, {"channels": d.COUNT})
    yield Subject(LSTMUpdate, lambda: {"state_dim": 2, "features": 4}, wrong=update)


def _updates() -> Iterator[Subject]:
    taper = {
        "one matrix": torch.ones(2, 2),
        "wrong shapes": (torch.ones(3, 2), torch.ones(2, 2)),
        "nan": (torch.full((2, 2), NAN), torch.ones(2, 2)),
        "text": "near",
    }
    near = {
        "nan": torch.full((2, 2), NAN),
        "negative": -torch.ones(2, 2),
        "a vector": torch.ones(2),
        "text": "near",
    }
    linear = {"matrix": BY_COLUMNS, "noise": d.covariance(2)}
    select = lambda: {"observation": m.Select([0, 1])}  # noqa: E731
    learned = {"bound": d.CHOICE, "num_cells": None, "network": None}
    yield Subject(m.EnsembleAnalysis, lambda: {"scheme": "sensor"}, on_row, {"taper": d.Wrong(taper)})
    yield Subject(m.LocalEnsembleAnalysis, lambda: {"near": torch.ones(2, 2)}, on_row, {"near": d.Wrong(near)})
    yield Subject(m.KalmanAnalysis, lambda: {"matrix": EYE.clone(), "noise": EYE.clone()}, on_row, linear)
    yield Subject(m.EKFAnalysis, select, on_row)
    yield Subject(m.UKFAnalysis, select, on_row, SIGMA)
    yield Subject(m.GaussianLikelihood, use=on_row)
    yield Subject(m.LearnedLikelihood, lambda: {"encoding_dim": 4, "observation_dim": 2}, on_row, learned)
    yield Subject(ParticleAnalysis, use=on_likelihoods)


def targets() -> Iterator[Target]:
    """The arguments of all sub-models."""
    for subjects in (_priors, _motions, _observations, _noises, _networks, _updates):
        yield from targets_of("sub-models", *subjects())
