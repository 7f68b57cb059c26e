"""Constructors of filters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.target import Subject, Target, annotations, targets_of
from torch_denkf.baselines import BackpropKF, LSTMFilter
from torch_denkf.filters import DPF, EKF, UKF, DEnKF, Filter, KalmanFilter, MixtureParticleFilter, ParticleFilter
from torch_denkf.modules import (
    ConstantNoise,
    GaussianLikelihood,
    GaussianPrior,
    LearnedTransition,
    LinearObservation,
    MomentPrior,
    StochasticMLP,
)

STDS = d.vector(2, negative=False)
#: Matrices of another precision than the other arguments', too.
TRANSITION = d.matrix(2, 2) | {"double precision": torch.eye(2, dtype=torch.float64)}
OBSERVATION = TRANSITION.but("a row more")  # that is another number of readings
SIGMA = {
    "alpha": d.POSITIVE,
    "beta": d.FINITE,
    "kappa": d.FINITE | {"minus the dimension": -2.0},
}
IMAGE_SHAPE = d.of((24, 24), (3, 0, 24), (3, -24, 24), "big")


def step_on_zeros(filter: Filter) -> Any:
    """Two steps, as a robot takes them."""
    row = filter.initialise(TensorDict({"observation": torch.zeros(2), "features": torch.zeros(4)}))
    return filter.step(filter.step(row))


def parts(members: int = 8) -> dict[str, Any]:
    """The modules of an ensemble or particle filter of two states, both of which are observed."""
    return {
        "transition": LearnedTransition(StochasticMLP(2, 2, (4,))),
        "sensor": None,
        "observation": LinearObservation(torch.eye(2)),
        "noise": ConstantNoise([0.5, 0.5], in_key="observation"),
        "initial": GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=members),
    }


def _linear() -> dict[str, Any]:
    return {"transition": 0.9 * torch.eye(2), "observation": torch.eye(2)}


def _kalman() -> dict[str, Any]:
    noise = {"process_noise_cov": 0.1 * torch.eye(2), "noise_cov": 0.2 * torch.eye(2)}
    return {**_linear(), **noise, "mean": torch.zeros(2), "cov": torch.eye(2)}


def _deviations() -> dict[str, Any]:
    moments = {"mean": torch.zeros(2), "cov": torch.eye(2)}
    return {**_linear(), **moments, "process_noise": [0.1, 0.1], "noise": [0.2, 0.2]}


def _denkf() -> dict[str, Any]:
    return {**parts(), "observation_key": "observation"}


def _gaussian() -> dict[str, Any]:
    prior = MomentPrior(torch.zeros(2), torch.eye(2))
    return {**_denkf(), "initial": prior, "process_noise": [0.1, 0.1]}


def _backprop() -> dict[str, Any]:
    plain = {name: value for name, value in _gaussian().items() if name != "process_noise"}
    return {**plain, **_linear(), "process_noise_cov": 0.1 * torch.eye(2)}


def _particle() -> dict[str, Any]:
    return {**parts(), "likelihood": GaussianLikelihood(observation_key="observation")}


def _dpf() -> dict[str, Any]:
    q = ConstantNoise([0.1], in_key=("belief", "mean"), out_key=("forecast", "q"))
    return {**_particle(), "motion_noise": q, "noisy_dims": [0]}


def _mixture() -> dict[str, Any]:
    return {**parts(), "learned_likelihood": GaussianLikelihood(observation_key="observation")}


def _lstm() -> dict[str, Any]:
    return {"sensor": None, "features": 4, "state_dim": 2, "encoding_key": "features"}


def _paper() -> dict[str, Any]:
    return {"state_dim": 2, "observation_dim": 2, "image_shape": (3, 24, 24), "ensemble_size": 4}


def _filter() -> dict[str, Any]:
    made = DEnKF(**_denkf())
    return {"modules": dict(made.module.items()), "initial": made.initial}


def _make_filter(modules: Any, initial: Any, variance_ceiling: Any = None) -> Filter:
    return Filter(modules, initial=initial, variance_ceiling=variance_ceiling)


def targets() -> Iterator[Target]:
    """The arguments of all filters."""
    use, particles = step_on_zeros, {"alpha": d.SHARE}
    names = {"transition": ("F",), "observation": ("H",), "process_noise_cov": ("Q",), "noise_cov": ("R",)}
    kalman = {
        "transition": TRANSITION,
        "observation": OBSERVATION,
        **dict.fromkeys(("process_noise_cov", "noise_cov", "cov"), d.covariance(2)),
        "control": d.matrix(2, 1).but("a column more"),
        "process_noise": None,
    }
    deviations = {**dict.fromkeys(annotations(KalmanFilter)), **dict.fromkeys(("process_noise", "noise"), STDS)}
    backprop = {"transition": TRANSITION, "observation": OBSERVATION, "process_noise_cov": d.covariance(2)}
    lstm = {
        **dict.fromkeys(("features", "observation_dim"), d.COUNT_OR_NONE),
        "scale": d.vector(2, positive=True),
        "floor": d.NOT_NEGATIVE,
        "initial": None,
        "modules": None,
        "dt": None,
    }
    paper = {"rate": d.RATE, "r": d.POSITIVE, "image_shape": IMAGE_SHAPE, "initial": None}
    pictures = lambda made: made.step(made.initialise(TensorDict({"pixels": torch.zeros(3, 24, 24)})))  # noqa: E731
    yield from targets_of(
        "filters",
        Subject(KalmanFilter, _kalman, use, kalman, names),
        Subject(KalmanFilter, _deviations, use, deviations, name="KalmanFilter of deviations"),
        Subject(EKF, _gaussian, use),
        Subject(UKF, _gaussian, use, SIGMA),
        Subject(BackpropKF, _backprop, use, backprop),
        Subject(DEnKF, _denkf, use),
        Subject(ParticleFilter, _particle, use, {**particles, "noise": d.MODULE}),
        Subject(DPF, _dpf, use, {**particles, "noisy_dims": d.dims(2)}, {"noisy_dims": ("dims",)}),
        Subject(MixtureParticleFilter, _mixture, use, particles),
        Subject(LSTMFilter, _lstm, use, lstm),
        Subject(DEnKF.paper, _paper, pictures, paper),
        Subject(_make_filter, _filter, use, name="Filter"),
    )
