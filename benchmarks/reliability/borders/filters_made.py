"""Constructors of filters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability.borders.subjects import Subject, cases_of
from benchmarks.reliability.case import Case
from benchmarks.reliability.damage import (
    CHOICE,
    COUNT,
    COUNT_OR_NONE,
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
from torch_denkf.filters import (
    DPF,
    EKF,
    UKF,
    BackpropKF,
    DEnKF,
    Filter,
    KalmanFilter,
    LSTMFilter,
    MixtureParticleFilter,
    ParticleFilter,
)
from torch_denkf.modules import (
    ConstantNoise,
    GaussianLikelihood,
    GaussianPrior,
    LearnedTransition,
    LinearObservation,
    MomentPrior,
    StochasticMLP,
)

CEILING = {key: value for key, value in POSITIVE.items() if key != "inf"}
STDS = vector(2, negative=False)


def double(values: dict[str, Any], size: tuple[int, ...]) -> dict[str, Any]:
    """With values of another precision than the other arguments'."""
    return {**values, "double precision": torch.eye(*size, dtype=torch.float64)}


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


def _kalman() -> dict[str, Any]:
    eye = torch.eye(2)
    return {
        "transition": 0.9 * eye,
        "transition_noise": 0.1 * eye,
        "observation": eye.clone(),
        "observation_noise": 0.2 * eye,
        "mean": torch.zeros(2),
        "cov": eye.clone(),
    }


def _denkf() -> dict[str, Any]:
    return {**parts(), "observation_key": "observation"}


def _gaussian() -> dict[str, Any]:
    prior = MomentPrior(torch.zeros(2), torch.eye(2))
    return {**parts(), "initial": prior, "process_noise": [0.1, 0.1], "observation_key": "observation"}


def _backprop() -> dict[str, Any]:
    eye = torch.eye(2)
    given = {"transition": 0.9 * eye, "process_noise": 0.1 * eye, "observation": eye.clone()}
    return {**_gaussian(), **given}


def _particle() -> dict[str, Any]:
    return {**parts(), "likelihood": GaussianLikelihood(sensor_key="observation")}


def _dpf() -> dict[str, Any]:
    q = ConstantNoise([0.1], in_key=("belief", "mean"), out_key=("forecast", "q"))
    return {**_particle(), "motion_noise": q, "noisy_dims": [0]}


def _mixture() -> dict[str, Any]:
    return {**parts(), "learned_likelihood": GaussianLikelihood(sensor_key="observation")}


def _filter() -> dict[str, Any]:
    made = DEnKF(**_denkf())
    return {"modules": dict(made.module.items()), "initial": made.initial}


def _make_filter(modules: Any, **options: Any) -> Filter:
    return Filter(modules, **options)


def subjects() -> list[Subject]:
    """All filters, with what each takes."""
    modules = dict.fromkeys(("transition", "observation", "noise", "initial"), MODULE)
    same_for_all = {"variance_ceiling": CEILING}
    gaussian = {"process_noise": STDS, "inflation": POSITIVE, "angles": angles(2), **same_for_all}
    sigma = {"alpha": POSITIVE, "beta": {"nan": float("nan"), "inf": float("inf"), "text": "much"}}
    sigma["kappa"] = {"minus the dimension": -2.0, "nan": float("nan"), "inf": float("inf"), "text": "much"}
    particle = {
        "resampling": CHOICE,
        "alpha": SHARE,
        "epsilon": POSITIVE,
        "ess_threshold": SHARE,
        "process_noise": STDS,
        **modules,
        **same_for_all,
    }
    linear = {"transition": double(matrix(2, 2), (2,)), "observation": double(matrix(2, 2), (2,))}
    del linear["observation"]["a row more"]  # that is another number of readings
    use = step_on_zeros
    return [
        Subject(
            "KalmanFilter",
            KalmanFilter,
            _kalman,
            {
                **linear,
                "transition_noise": covariance(2),
                "observation_noise": covariance(2),
                "cov": covariance(2),
                "mean": vector(2),
                "control": {k: v for k, v in matrix(2, 1).items() if k != "a column more"},
                "angles": angles(2),
                **same_for_all,
            },
            use,
            also={"transition": ("F",), "observation": ("H",), "transition_noise": ("Q",), "observation_noise": ("R",)},
        ),
        Subject("EKF", EKF, _gaussian, {**gaussian, **modules}, use),
        Subject("UKF", UKF, _gaussian, {**gaussian, **sigma, **modules}, use),
        Subject(
            "BackpropKF",
            BackpropKF,
            _backprop,
            {**gaussian, **linear, "process_noise": covariance(2), "initial": MODULE, "noise": MODULE},
            use,
        ),
        Subject("DEnKF", DEnKF, _denkf, {**modules, "process_noise": STDS, "angles": angles(2), **same_for_all}, use),
        Subject("ParticleFilter", ParticleFilter, _particle, particle, use),
        Subject("DPF", DPF, _dpf, {"noisy_dims": dims(2), "initial": MODULE}, use, also={"noisy_dims": ("dims",)}),
        Subject("MixtureParticleFilter", MixtureParticleFilter, _mixture, {"alpha": SHARE, "initial": MODULE}, use),
        Subject(
            "LSTMFilter",
            LSTMFilter,
            lambda: {"sensor": None, "features": 4, "state_dim": 2, "encoding_key": "features"},
            {
                "state_dim": COUNT,
                "hidden_size": COUNT,
                "num_layers": COUNT,
                "features": COUNT_OR_NONE,
                "loc": vector(2),
                "scale": vector(2, positive=True),
                "floor": NOT_NEGATIVE,
            },
            use,
        ),
        Subject(
            "DEnKF.paper",
            DEnKF.paper,
            lambda: {"state_dim": 2, "observation_dim": 2, "image_shape": (3, 24, 24), "ensemble_size": 4},
            {
                "state_dim": COUNT,
                "observation_dim": COUNT,
                "ensemble_size": LARGE_COUNT,
                "rate": {**SHARE, "one": 1.0, "too small for eight bits": 0.001},
                "r": POSITIVE,
                "image_shape": {"two numbers": (24, 24), "zero": (3, 0, 24), "negative": (3, -24, 24), "text": "big"},
            },
            lambda made: made.step(made.initialise(TensorDict({"pixels": torch.zeros(3, 24, 24)}))),
        ),
        Subject("Filter", _make_filter, _filter, {"initial": MODULE, "modules": MODULE, **same_for_all}, use),
    ]


def cases() -> Iterator[Case]:
    """All damaged arguments."""
    yield from cases_of("filters", subjects())
