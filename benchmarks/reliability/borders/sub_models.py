"""Constructors of sub-models."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict
from torch import nn

from benchmarks.reliability.borders.subjects import Subject, cases_of
from benchmarks.reliability.case import Case
from benchmarks.reliability.damage import (
    CHOICE,
    COUNT,
    COUNT_OR_NONE,
    FINITE,
    LARGE_COUNT,
    MODULE,
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    angles,
    covariance,
    dims,
    matrix,
    vector,
)
from torch_denkf import modules as m

RATE = {**SHARE, "one": 1.0, "too small for eight bits": 0.001}
STDS = vector(2, negative=False, length=False)
SCALE = {what: value for what, value in vector(2, positive=True).items() if what != "inf"}  # infinity hides an input
DT = {what: value for what, value in POSITIVE.items() if what not in ("text", "zero")}  # text is a key
EYE = torch.eye(2)


def row() -> TensorDict:
    """What a step of two states and two readings may find."""
    made = TensorDict({"observation": torch.zeros(2), "action": torch.zeros(1), "state": torch.zeros(2)})
    for place in ("belief", "forecast", "sensor"):
        made[place, "ensemble"] = torch.randn(8, 2)
        made[place, "mean"], made[place, "cov"] = torch.zeros(2), EYE.clone()
    made["forecast", "observation"], made["sensor", "noise"] = torch.randn(8, 2), torch.ones(2)
    made["belief", "log_weight"] = torch.full((8,), -2.0794415)
    made["forecast", "log_weight"] = torch.full((8,), -2.0794415)
    made["sensor", "encoding"], made["measurement"] = torch.zeros(4), torch.zeros(4)
    made["pixels"] = torch.zeros(3, 24, 24)
    return made


def car() -> TensorDict:
    """What a step of a car may find."""
    made = row()
    for place in ("belief", "forecast", "analysis"):
        made[place, "ensemble"] = torch.randn(8, 5)
        made[place, "mean"], made[place, "cov"] = torch.zeros(5), torch.eye(5)
    return made


def on_row(module: Any) -> Any:
    """Runs a sub-model as a filter does."""
    return module(row())


def on_car(module: Any) -> Any:
    """Likewise, of a car."""
    return module(car())


def _process_noise() -> Any:
    return m.ConstantNoise([0.1, 0.1], in_key=("belief", "mean"), out_key=("forecast", "noise"))


def _priors() -> list[Subject]:
    size = {"ensemble_size": LARGE_COUNT}
    prior = lambda: {"mean": [0.0, 0.0], "std": [1.0, 1.0]}  # noqa: E731
    return [
        Subject(
            "GaussianPrior",
            m.GaussianPrior,
            prior,
            {"mean": vector(2), "std": {**STDS, "too long": [1.0] * 3}, **size},
            on_row,
        ),
        Subject(
            "AroundState",
            m.AroundState,
            lambda: {"std": [1.0, 1.0]},
            {"std": {**STDS, "too long": [1.0] * 3}, **size},
            on_row,
        ),
        Subject(
            "FromSensor",
            m.FromSensor,
            lambda: {**prior(), "dims": [0, 1]},
            {"dims": dims(2), "mean": vector(2), "std": {**STDS, "too long": [1.0] * 3}, **size},
            on_row,
        ),
        Subject(
            "MomentPrior",
            m.MomentPrior,
            lambda: {"mean": torch.zeros(2), "cov": EYE.clone()},
            {"mean": vector(2), "cov": covariance(2)},
            on_row,
            also={"mean": ("cov",)},  # of two sizes, either may be wrong
        ),
        Subject(
            "GaussianAround",
            m.GaussianAround,
            lambda: {"std": [1.0, 1.0]},
            {"std": {**STDS, "too long": [1.0] * 3}},
            on_row,
        ),
        Subject(
            "WithMemory",
            m.WithMemory,
            lambda: {"initial": m.MomentPrior(torch.zeros(2), EYE), "hidden_size": 4},
            {"initial": MODULE, "hidden_size": COUNT, "num_layers": COUNT},
            on_row,
        ),
        Subject(
            "WithHistory",
            m.WithHistory,
            lambda: {"initial": m.GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=8), "lags": 2},
            {"initial": MODULE, "lags": COUNT},
            on_row,
        ),
        Subject(
            "ClonedPrior",
            m.ClonedPrior,
            lambda: {"initial": m.MomentPrior(torch.zeros(5), torch.eye(5)), "lags": 2},
            {"initial": MODULE, "lags": COUNT},
            on_row,
        ),
        Subject(
            "WithWeights",
            m.WithWeights,
            lambda: {"initial": m.GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=8)},
            {"initial": MODULE},
            on_row,
        ),
    ]


def _motions() -> list[Subject]:
    def net() -> nn.Module:
        return m.StochasticMLP(2, 2, (4,))

    return [
        Subject(
            "LearnedTransition",
            m.LearnedTransition,
            lambda: {"network": net()},
            {"network": MODULE, "loc": vector(2), "scale": SCALE},
            on_row,
        ),
        Subject(
            "UnicycleTransition",
            m.UnicycleTransition,
            lambda: {"velocity": net(), "dt": 0.1},
            {
                "velocity": MODULE,
                "dt": DT,
                "loc": vector(2),
                "scale": SCALE,
            },
            on_car,
        ),
        Subject(
            "UnicycleMotion",
            m.UnicycleMotion,
            lambda: {"dt": 0.1},
            {"dt": DT},
            on_car,
        ),
        Subject(
            "UnicyclePose",
            m.UnicyclePose,
            lambda: {"dt": 0.1},
            {"dt": DT},
        ),
        Subject(
            "LinearTransition",
            m.LinearTransition,
            lambda: {"matrix": 0.9 * EYE, "noise": 0.1 * EYE, "control": torch.ones(2, 1)},
            {
                "matrix": matrix(2, 2),
                "noise": covariance(2),
                "control": {k: v for k, v in matrix(2, 1).items() if k != "a column more"},
            },
            on_row,
        ),
        Subject(
            "EKFTransition",
            m.EKFTransition,
            lambda: {"transition": m.LearnedTransition(net()), "process_noise": _process_noise()},
            {"transition": MODULE, "process_noise": MODULE},
            on_row,
        ),
        Subject(
            "UKFTransition",
            m.UKFTransition,
            lambda: {"transition": m.LearnedTransition(net()), "process_noise": _process_noise()},
            {
                "transition": MODULE,
                "process_noise": MODULE,
                "alpha": POSITIVE,
                "kappa": {**FINITE, "minus the dimension": -2.0},
            },
            on_row,
        ),
        Subject(
            "NoisyTransition",
            m.NoisyTransition,
            lambda: {"transition": m.LearnedTransition(net()), "noise": _process_noise(), "dims": [0, 1]},
            {"transition": MODULE, "noise": MODULE, "dims": dims(2)},
            on_row,
        ),
        Subject(
            "ResampledTransition",
            m.ResampledTransition,
            lambda: {"transition": m.LearnedTransition(net())},
            {
                "transition": MODULE,
                "scheme": CHOICE,
                "alpha": SHARE,
                "epsilon": POSITIVE,
                "iterations": COUNT,
                "ess_threshold": SHARE,
            },
            on_row,
        ),
        Subject(
            "ClonedTransition",
            m.ClonedTransition,
            lambda: {"transition": m.LearnedTransition(net())},
            {"transition": MODULE},
        ),
    ]


def _observations() -> list[Subject]:
    return [
        Subject("Select", m.Select, lambda: {"dims": [0, 1]}, {"dims": angles(2)}, on_row),
        Subject(
            "LinearObservation",
            m.LinearObservation,
            lambda: {"matrix": EYE.clone()},
            {"matrix": {k: v for k, v in matrix(2, 2).items() if k != "a row more"}},
            on_row,
        ),
        Subject(
            "LearnedObservation",
            m.LearnedObservation,
            lambda: {"network": nn.Linear(2, 2)},
            {"network": MODULE, "loc": vector(2), "scale": SCALE},
            on_row,
        ),
        Subject(
            "PairObservation",
            m.PairObservation,
            lambda: {"reach": [1.0]},
            {"reach": {"nan": [float("nan")], "negative": [-1.0], "zero": [0.0], "text": "far"}},
        ),
    ]


def _noises() -> list[Subject]:
    stds = {**vector(2, positive=True), "a matrix": torch.ones(2, 3)}
    return [
        Subject(
            "DiagonalNoise",
            m.DiagonalNoise,
            lambda: {"observation_dim": 2},
            {
                "observation_dim": COUNT,
                "r": stds,
                "floor": {"negative": -0.1, "nan": float("nan"), "beyond r": 5.0, "text": "much"},
                "in_features": COUNT,
                "num_cells": {"zero": (0,), "negative": (-4,), "fraction": (2.5,), "text": "wide"},
                "loc": vector(2),
                "scale": SCALE,
            },
            on_row,
        ),
        Subject(
            "ConstantNoise",
            m.ConstantNoise,
            lambda: {"r": [0.5, 0.5]},
            {"r": {k: v for k, v in stds.items() if k not in ("too long", "a matrix", "zero")}},
            on_row,
        ),
        Subject(
            "CholeskyNoise",
            m.CholeskyNoise,
            lambda: {"dim": 2},
            {
                "dim": COUNT,
                "r": stds,
                "floor": {"negative": -0.1, "nan": float("nan"), "beyond r": 5.0, "text": "much"},
            },
            on_row,
        ),
        Subject(
            "ScaledNoise",
            m.ScaledNoise,
            lambda: {"noise": m.ConstantNoise([0.5, 0.5]), "factor": 1.0},
            {"noise": MODULE, "factor": NOT_NEGATIVE},
            on_row,
        ),
        Subject(
            "MappedNoise",
            m.MappedNoise,
            lambda: {"noise": _process_noise(), "matrix": EYE.clone()},
            {"noise": MODULE, "matrix": {k: v for k, v in matrix(2, 2).items() if k != "a row more"}},
            on_row,
        ),
        Subject(
            "UnicycleNoise",
            m.UnicycleNoise,
            lambda: {"noise": _process_noise(), "dt": 0.1},
            {"noise": MODULE, "dt": DT},
            on_car,
        ),
    ]


def _networks() -> list[Subject]:
    cells = {"zero": (0,), "negative": (-4,), "fraction": (2.5,), "text": "wide"}
    layer = {"rate": RATE, "layer": CHOICE, "num_cells": cells}
    image = torch.zeros(2, 3, 24, 24)
    return [
        Subject(
            "StochasticMLP",
            m.StochasticMLP,
            lambda: {"in_features": 2, "out_features": 2},
            {
                "in_features": COUNT,
                "out_features": COUNT,
                **layer,
                "posterior_std": NOT_NEGATIVE,
                "output_gain": FINITE,
            },
            lambda made: made(torch.zeros(8, 2)),
        ),
        Subject(
            "FlipoutLinear",
            m.FlipoutLinear,
            lambda: {"in_features": 2, "out_features": 2},
            {"in_features": COUNT, "out_features": COUNT, "posterior_std": NOT_NEGATIVE, "prior_std": POSITIVE},
            lambda made: made(torch.zeros(8, 2)),
        ),
        Subject(
            "ImageSensor",
            m.ImageSensor,
            lambda: {"observation_dim": 2, "image_shape": (3, 24, 24), "ensemble_size": 4},
            {
                "observation_dim": COUNT,
                "ensemble_size": COUNT,
                "image_shape": {"two numbers": (24, 24), "zero": (3, 0, 24), "negative": (3, -24, 24), "text": "big"},
                "loc": vector(2),
                "scale": SCALE,
                "pixel_loc": vector(3),
                "pixel_scale": vector(3, positive=True),
                "trunk_memory": COUNT,
                **layer,
            },
            on_row,
        ),
        Subject(
            "VectorSensor",
            m.VectorSensor,
            lambda: {"in_features": 4, "observation_dim": 2, "ensemble_size": 4},
            {
                "in_features": COUNT,
                "observation_dim": COUNT,
                "ensemble_size": COUNT,
                "loc": vector(4),
                "scale": vector(4, positive=True),
                **layer,
            },
            on_row,
        ),
        Subject(
            "FlowSensor",
            m.FlowSensor,
            lambda: {"dt": 0.1},
            {
                "dt": POSITIVE,
                "ensemble_size": COUNT,
                "features": COUNT,
                "trunk_dropout": {**SHARE, "one": 1.0},
                **layer,
            },
        ),
        Subject(
            "MemberGain",
            m.MemberGain,
            lambda: {"std": [0.1, 0.1], "ensemble_size": 8},
            {"std": {**STDS, "too long": [1.0] * 3}, "ensemble_size": LARGE_COUNT},
            on_row,
        ),
        Subject(
            "KeypointTrunk",
            m.KeypointTrunk,
            lambda: {"in_channels": 3, "channels": (8, 8), "keypoints": 4, "features": 8, "pooled": 2},
            {"in_channels": COUNT, "channels": cells, "keypoints": COUNT, "features": COUNT, "pooled": COUNT},
            lambda made: made(image),
        ),
        Subject(
            "SpatialSoftArgmax",
            m.SpatialSoftArgmax,
            lambda: {"channels": 3},
            {"channels": COUNT},
            lambda made: made(image),
        ),
        Subject(
            "LSTMUpdate",
            m.LSTMUpdate,
            lambda: {"state_dim": 2, "features": 4},
            {
                "state_dim": COUNT,
                "features": COUNT_OR_NONE,
                "hidden_size": COUNT,
                "num_layers": COUNT,
                "floor": NOT_NEGATIVE,
                "loc": vector(2),
                "scale": SCALE,
            },
        ),
    ]


def _updates() -> list[Subject]:
    return [
        Subject(
            "EnsembleAnalysis",
            m.EnsembleAnalysis,
            lambda: {"scheme": "sensor"},
            {
                "scheme": CHOICE,
                "inflation": POSITIVE,
                "relaxation": SHARE,
                "angles": angles(2),
                "taper": {
                    "one matrix": torch.ones(2, 2),
                    "wrong shapes": (torch.ones(3, 2), torch.ones(2, 2)),
                    "nan": (torch.full((2, 2), float("nan")), torch.ones(2, 2)),
                    "text": "near",
                },
            },
            on_row,
        ),
        Subject(
            "LocalEnsembleAnalysis",
            m.LocalEnsembleAnalysis,
            lambda: {"near": torch.ones(2, 2)},
            {
                "near": {
                    "nan": torch.full((2, 2), float("nan")),
                    "negative": -torch.ones(2, 2),
                    "a vector": torch.ones(2),
                    "text": "near",
                },
                "inflation": POSITIVE,
                "relaxation": SHARE,
                "tile": COUNT,
                "angles": angles(2),
            },
            on_row,
        ),
        Subject(
            "KalmanAnalysis",
            m.KalmanAnalysis,
            lambda: {"matrix": EYE.clone(), "noise": EYE.clone()},
            {
                "matrix": {k: v for k, v in matrix(2, 2).items() if k != "a row more"},
                "noise": covariance(2),
                "inflation": POSITIVE,
                "angles": angles(2),
            },
            on_row,
        ),
        Subject(
            "EKFAnalysis",
            m.EKFAnalysis,
            lambda: {"observation": m.Select([0, 1])},
            {"observation": MODULE, "inflation": POSITIVE, "angles": angles(2)},
            on_row,
        ),
        Subject(
            "UKFAnalysis",
            m.UKFAnalysis,
            lambda: {"observation": m.Select([0, 1])},
            {
                "observation": MODULE,
                "inflation": POSITIVE,
                "angles": angles(2),
                "alpha": POSITIVE,
                "kappa": {**FINITE, "minus the dimension": -2.0},
            },
            on_row,
        ),
        Subject("GaussianLikelihood", m.GaussianLikelihood, dict, {"angles": angles(2)}, on_row),
        Subject(
            "LearnedLikelihood",
            m.LearnedLikelihood,
            lambda: {"encoding_dim": 4, "observation_dim": 2},
            {"encoding_dim": COUNT, "observation_dim": COUNT, "bound": CHOICE, "loc": vector(2), "scale": SCALE},
            on_row,
        ),
        Subject(
            "ParticleAnalysis",
            m.ParticleAnalysis,
            dict,
            {"tempering": POSITIVE},
            lambda made: made(row().set(("forecast", "log_likelihood"), torch.zeros(8))),
        ),
    ]


def cases() -> Iterator[Case]:
    """All damaged arguments."""
    everything = [*_priors(), *_motions(), *_observations(), *_noises(), *_networks(), *_updates()]
    yield from cases_of("sub-models", everything)
