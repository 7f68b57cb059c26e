"""Constructors of sub-models."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import NAN
from benchmarks.reliability.target import Subject, Target, targets_of
from tests.borders.filters_made import EYE, IMAGE_SHAPE, SIGMA
from torch_denkf import modules as m
from torch_denkf._arguments import _signature
from torch_denkf.applications.car import FlowSensor, UnicycleMotion, UnicycleTransition
from torch_denkf.applications.car.modules.member_gain import MemberGain
from torch_denkf.applications.car.modules.pairs import ClonedPrior, ClonedTransition, PairObservation, with_history
from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.applications.car.modules.unicycle_pose import UnicyclePose
from torch_denkf.baselines.lstm_cell import LSTMUpdate, with_memory
from torch_denkf.functional.manifolds import SE2
from torch_denkf.imperfect import Contaminated, RejectReadings, Visible
from torch_denkf.modules.keypoints import SpatialSoftArgmax
from torch_denkf.modules.particles import ParticleAnalysis, ResampledTransition, with_weights
from torch_denkf.modules.stochastic import FlipoutLinear

BY_COLUMNS = d.matrix(2, 2).but("a row more")
STDS = d.vector(2, positive=True) | {"a matrix": torch.ones(2, 3)}
FLOOR = d.of(-0.1, NAN, 5.0, "much")
NET, NOISE = (
    m.StochasticMLP(2, 2, (4,)),
    m.ConstantNoise([0.1] * 2, in_key=("belief", "mean"), out_key=("forecast", "noise")),
)
#: Right values of arguments, by their names.
GIVEN: dict[str, Any] = {
    **{"mean": [0.0, 0.0], "std": [1.0, 1.0], "cov": EYE, "matrix": EYE, "near": torch.ones(2, 2), "r": [0.5, 0.5]},
    **{"dims": [0, 1], "lags": 2, "hidden_size": 4, "dt": 0.1, "ensemble_size": 8, "reach": [1.0], "channels": 3},
    **{"in_features": 2, "out_features": 2, "observation_dim": 2, "encoding_dim": 4, "dim": 2, "state_dim": 2},
    **{"network": NET, "velocity": NET, "transition": m.LearnedTransition(NET), "noise": NOISE, "process_noise": NOISE},
    **{"initial": m.GaussianPrior([0.0] * 2, [1.0] * 2, ensemble_size=8), "observation": m.Select([0, 1])},
}


def row(states: int = 2) -> TensorDict:
    """Returns what a step of two readings may find."""
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


def not_run(module: Any) -> Any:
    """Only makes it."""


def of(
    make: Callable[..., Any],
    use: Callable[[Any], Any] = on_row,
    wrong: Mapping[str, d.Wrong | None] | None = None,
    also: Mapping[str, tuple[str, ...]] | None = None,
    **given: Any,
) -> Subject:
    """Returns a sub-model; arguments that have no default are those of ``GIVEN``, except for some."""
    signature = _signature(make)[0] if isinstance(make, type) else inspect.signature(make)
    needed = [name for name, one in signature.parameters.items() if one.default is one.empty and name in GIVEN]
    sound = partial(copy.deepcopy, {**{name: GIVEN[name] for name in needed}, **given})
    return Subject(make, sound, use, wrong or {}, also or {})


def _motions() -> Iterator[Subject]:
    moments, car = m.MomentPrior(torch.zeros(2), EYE), m.MomentPrior(torch.zeros(5), torch.eye(5))
    linear = {"matrix": d.matrix(2, 2), "noise": d.covariance(2), "control": d.matrix(2, 1).but("a column more")}
    dims, module = {"dims": d.dims(2)}, {"process_noise": d.MODULE}
    for make in (m.GaussianPrior, m.AroundState, m.GaussianAround, with_history, with_weights, m.LearnedTransition):
        yield of(make)
    yield of(m.FromSensor, wrong=dims)
    zeros = torch.zeros(2)
    yield of(m.MomentPrior, wrong={"cov": d.covariance(2)}, also={"mean": ("cov",)}, mean=zeros)  # either may be wrong
    yield of(with_memory, initial=moments)
    yield of(ClonedPrior, initial=car)
    yield of(UnicycleTransition, on_car)
    yield of(UnicycleMotion, on_car)
    yield of(UnicyclePose, not_run)
    yield of(m.LinearTransition, wrong=linear, matrix=0.9 * EYE, noise=0.1 * EYE, control=torch.ones(2, 1))
    yield of(m.EKFTransition, wrong=module)
    yield of(m.UKFTransition, wrong={**SIGMA, **module})
    yield of(m.NoisyTransition, wrong=dims, dims=[0, 1])
    yield of(ResampledTransition, wrong={"alpha": d.SHARE})
    yield of(ClonedTransition, not_run)


def _observations() -> Iterator[Subject]:
    cholesky = {"r": STDS, "floor": FLOOR, **dict.fromkeys(("loc", "scale", "in_features", "num_cells"))}
    yield of(m.Select, wrong={"dims": d.indices(2)})
    yield of(m.LinearObservation, wrong={"matrix": BY_COLUMNS})
    yield of(m.LearnedObservation, network=nn.Linear(2, 2))
    yield of(PairObservation, not_run, {"reach": d.of([NAN], [-1.0], [0.0], "far")})
    yield of(m.DiagonalNoise, wrong={"r": STDS, "floor": FLOOR})
    yield of(m.ConstantNoise, wrong={"r": STDS.but("too long", "a matrix", "zero")})
    yield of(m.CholeskyNoise, wrong=cholesky)
    yield of(m.ScaledNoise, noise=m.ConstantNoise([0.5, 0.5]), factor=1.0)
    yield of(m.MappedNoise, wrong={"matrix": BY_COLUMNS})
    yield of(UnicycleNoise, on_car)


def _networks() -> Iterator[Subject]:
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
    yield of(m.StochasticMLP, on_vectors, {"output_gain": d.FINITE})
    yield of(FlipoutLinear, on_vectors)
    yield of(m.ImageSensor, wrong=images, image_shape=(3, 24, 24), ensemble_size=4)
    yield of(m.VectorSensor, wrong=readings, in_features=4, ensemble_size=4)
    yield of(FlowSensor, not_run, flow)
    yield of(MemberGain, in_key=("sensor", "ensemble"), std=[0.1, 0.1])
    yield of(m.KeypointTrunk, on_images, {"channels": d.CELLS}, **trunk)
    yield of(SpatialSoftArgmax, on_images, {"channels": d.COUNT})
    yield of(LSTMUpdate, not_run, update, features=4)


def _updates() -> Iterator[Subject]:
    ones, nan = torch.ones(2, 2), torch.full((2, 2), NAN)
    taper = {"one matrix": ones, "wrong shapes": (torch.ones(3, 2), ones), "nan": (nan, ones), "text": "near"}
    near = {"nan": nan, "negative": -ones, "a vector": torch.ones(2), "text": "near"}
    linear = {"matrix": BY_COLUMNS, "noise": d.covariance(2)}
    learned = {"bound": d.CHOICE, "num_cells": None, "network": None}
    yield of(m.EnsembleAnalysis, wrong={"taper": d.Wrong(taper)}, scheme="sensor")
    yield of(m.LocalEnsembleAnalysis, wrong={"near": d.Wrong(near)})
    yield of(m.KalmanAnalysis, wrong=linear, noise=EYE)
    yield of(m.EKFAnalysis)
    yield of(m.UKFAnalysis, wrong=SIGMA)
    yield of(m.GaussianLikelihood)
    yield of(m.LearnedLikelihood, wrong=learned)
    yield of(ParticleAnalysis, on_likelihoods)


def _imperfect() -> Iterator[Subject]:
    masks = {
        "none": {},
        "a list": ["observation"],
        "no key": {"observation": 3},
        "the reading itself": {"observation": "observation"},
    }
    rejecting = {
        "masks": d.Wrong(masks),
        "on_bad": d.of("warn"),
        "by_component": d.of(["y"]),
        "noises": d.of({"y": "n"}, ["observation"]),
        "spaces": d.of({"y": SE2()}, {"observation": 3}),
        "limit": d.POSITIVE,
        "count_key": d.of(3, "observed"),
        "limits": d.of(3),
    }
    inner, others = m.EnsembleAnalysis("etkf"), (ParticleAnalysis(), m.Select([0]), m.LearnedLikelihood(4, 2))
    contaminated = {
        "analysis": d.of(Contaminated(inner), Visible(inner), *others),
        "share": d.of(-0.1, 1.1, [0.1, 0.2]),
        "width": d.of(0.0, [2.0, 3.0]),
        "noise": d.of([0.0], 2.0),
    }
    visible = {"analysis": d.of(Visible(inner), *others), "broad": d.of(1.0)}
    words = ("'observation' twice", "'observed' twice", "space of 'observation'")
    yield of(RejectReadings, on_row, rejecting, dict.fromkeys(rejecting, words), masks={"observation": "observed"})
    yield of(Contaminated, not_run, contaminated, {"analysis": ("Contaminated",)}, analysis=inner)
    yield of(Visible, not_run, visible, {"analysis": ("Visible",)}, analysis=inner)


def targets() -> Iterator[Target]:
    """Yields the arguments of all sub-models."""
    for subjects in (_motions, _observations, _networks, _updates, _imperfect):
        yield from targets_of("sub-models", *subjects())
