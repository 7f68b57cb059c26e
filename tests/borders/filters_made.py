"""Arguments of the filters' constructors."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from functools import partial
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.target import Subject, Target, annotations, targets_of
from torch_denkf import modules as m
from torch_denkf.baselines import BackpropKF, LSTMFilter
from torch_denkf.filters import DPF, EKF, UKF, DEnKF, Filter, KalmanFilter, MixtureParticleFilter, ParticleFilter

EYE = torch.eye(2)
STDS = d.vector(2, negative=False)
#: One case has another precision than the other arguments.
TRANSITION = d.matrix(2, 2) | {"double precision": EYE.double()}
OBSERVATION = TRANSITION.but("a row more")  # a further row is valid: it is one more component of the observation
SIGMA = {"alpha": d.POSITIVE, "beta": d.FINITE, "kappa": d.FINITE | {"minus the dimension": -2.0}}
IMAGE_SHAPE = d.of((24, 24), (3, 0, 24), (3, -24, 24), "big")


def parts(members: int = 8) -> dict[str, Any]:
    """Returns the modules of an ensemble or particle filter with two state components, both observed."""
    return {
        "transition": m.LearnedTransition(m.StochasticMLP(2, 2, (4,))),
        "sensor": None,
        "observation": m.LinearObservation(torch.eye(2)),
        "noise": m.ConstantNoise([0.5, 0.5], in_key="observation"),
        "initial": m.GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=members),
    }


def step_on_zeros(filter: Filter) -> Any:
    """Resets a filter, and takes two steps."""
    row = filter.initialise(TensorDict({"observation": torch.zeros(2), "features": torch.zeros(4)}))
    return filter.step(filter.step(row))


LINEAR = {"transition": 0.9 * EYE, "observation": EYE, "mean": torch.zeros(2), "cov": EYE}
READ = {"observation_key": "observation"}
PRIOR = {**READ, "initial": m.MomentPrior(torch.zeros(2), EYE), "process_noise": [0.1, 0.1]}
WEIGHED = {**parts(), "likelihood": m.GaussianLikelihood(**READ)}
MOVED = m.ConstantNoise([0.1], in_key=("belief", "mean"), out_key=("forecast", "q"))


def _made(modules: Any, initial: Any, variance_ceiling: Any = None) -> Filter:
    return Filter(modules, initial=initial, variance_ceiling=variance_ceiling)


def targets() -> Iterator[Target]:
    """Yields the arguments of all filters."""
    names = {"transition": ("F",), "observation": ("H",), "process_noise_cov": ("Q",), "noise_cov": ("R",)}
    matrices = {"transition": TRANSITION, "observation": OBSERVATION}
    covariances = dict.fromkeys(("process_noise_cov", "noise_cov", "cov"), d.covariance(2))
    kalman = {**matrices, **covariances, "control": d.matrix(2, 1).but("a column more"), "process_noise": None}
    deviations = {**dict.fromkeys(annotations(KalmanFilter)), **dict.fromkeys(("process_noise", "noise"), STDS)}
    lstm = {
        **dict.fromkeys(("features", "observation_dim"), d.COUNT_OR_NONE),
        "scale": d.vector(2, positive=True),
        "floor": d.NOT_NEGATIVE,
        **dict.fromkeys(("initial", "modules", "dt")),
    }
    paper = {"rate": d.RATE, "r": d.POSITIVE, "image_shape": IMAGE_SHAPE, "initial": None}
    small = {"state_dim": 2, "observation_dim": 2, "image_shape": (3, 24, 24), "ensemble_size": 4}
    pictures = lambda made: made.step(made.initialise(TensorDict({"pixels": torch.zeros(3, 24, 24)})))  # noqa: E731
    filter, memory = DEnKF(**parts(), **READ), {"features": 4, "state_dim": 2, "encoding_key": "features"}
    modules = {"modules": dict(filter.module.items()), "initial": filter.initial}
    noisy_dims = {"alpha": d.SHARE, "noisy_dims": d.dims(2)}
    learned = {**PRIOR, **LINEAR, "process_noise_cov": 0.1 * EYE}
    for make, given, wrong, more in (
        (KalmanFilter, {**LINEAR, "process_noise_cov": 0.1 * EYE, "noise_cov": 0.2 * EYE}, kalman, {"also": names}),
        (KalmanFilter, {**LINEAR, "process_noise": [0.1] * 2, "noise": [0.2] * 2}, deviations, {"name": "deviations"}),
        (EKF, {**parts(), **PRIOR}, {}, {}),
        (UKF, {**parts(), **PRIOR}, SIGMA, {}),
        (BackpropKF, {**parts(), **learned}, {**matrices, "process_noise_cov": covariances["cov"]}, {}),
        (DEnKF, {**parts(), **READ}, {}, {}),
        (ParticleFilter, WEIGHED, {"alpha": d.SHARE, "noise": d.MODULE}, {}),
        (DPF, {**WEIGHED, "motion_noise": MOVED, "noisy_dims": [0]}, noisy_dims, {"also": {"noisy_dims": ("dims",)}}),
        (MixtureParticleFilter, {**parts(), "learned_likelihood": WEIGHED["likelihood"]}, {"alpha": d.SHARE}, {}),
        (LSTMFilter, {"sensor": None, **memory}, lstm, {}),
        (DEnKF.paper, small, paper, {"use": pictures}),
        (_made, modules, {}, {"name": "Filter"}),
    ):
        taken = {name: value for name, value in given.items() if name in annotations(make)}
        sound = partial(copy.deepcopy, taken)
        yield from targets_of("filters", Subject(make, sound, **{"use": step_on_zeros, "wrong": wrong, **more}))
