"""Arguments of constructors that depend on others, complex numbers, and covariances that are right."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict

from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.applications.car import UnicycleMotion
from torch_denkf.baselines.lstm_cell import LSTMUpdate
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.filters import DEnKF, KalmanFilter
from torch_denkf.functional.manifolds import Circle, Flat
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import (
    DiagonalNoise,
    GaussianPrior,
    LinearObservation,
    MomentPrior,
    Select,
)

EYE, ZERO, ONE = torch.eye(2), torch.zeros(2), torch.ones(2)
NAN, INF = float("nan"), float("inf")
PARTS = {
    "transition": EYE,
    "process_noise_cov": EYE,
    "observation": EYE,
    "noise_cov": EYE,
    "mean": ZERO,
    "cov": EYE,
}


def refused(make, *words, error=ValueError):
    """The message, which holds these words."""
    with pytest.raises(error) as caught:
        make()
    message = str(caught.value)
    missing = [word for word in words if word not in message]
    assert not missing, message
    return message


def refuses(make, *words, error=ValueError):
    """The message begins with the argument's name and holds these words."""
    assert refused(make, *words, error=error).startswith(words[0])


@pytest.mark.parametrize(
    ("noises", "words"),
    [
        ({"process_noise": [1.0], "noise": [1.0, 1.0]}, "not both"),
        ({}, "Give noise, standard deviations"),
    ],
)
def test_noises_of_a_kalman_filter(noises, words):
    parts = {name: value for name, value in PARTS.items() if name != "noise_cov"}
    with pytest.raises(ValueError, match=words):
        KalmanFilter(**parts, **noises)


@pytest.mark.parametrize("name", [*PARTS, "control"])
@pytest.mark.parametrize("of", [torch.Tensor.clone, torch.Tensor.numpy, torch.Tensor.tolist])
def test_an_imaginary_part_is_not_dropped(name, of):
    value = of((1 + 0.5j) * PARTS.get(name, EYE))
    refuses(lambda: KalmanFilter(**{**PARTS, name: value}), name, "complex", error=TypeError)


def test_an_imaginary_part_is_not_dropped_elsewhere():
    one = (1 + 0.5j) * ONE
    for name, make in (
        ("mean", lambda: GaussianPrior(one, ONE, ensemble_size=4)),
        ("std", lambda: GaussianPrior(ONE, one.numpy(), ensemble_size=4)),
        ("cov", lambda: MomentPrior(ZERO, 1j * EYE)),
        ("matrix", lambda: LinearObservation(1j * EYE)),
        ("observation", lambda: LinearGaussianEnv(EYE, 1j * EYE, [1.0, 1.0], [1.0, 1.0])),
        ("transition_std", lambda: LinearGaussianEnv(EYE, EYE, one, [1.0, 1.0])),
        ("process_noise", lambda: linear_filter("EKF", process_noise=one)),
    ):
        refuses(make, name, "complex", error=TypeError)


REFUSED = {
    "circular": (lambda: Flat(2, circular=[-1]), "circular", "got -1"),
    "a space of fewer": (lambda: KalmanFilter(**PARTS, reading_space=Circle()), "reading_space", "2 rows of matrix"),
    "no double": (lambda: DiagonalNoise(2, r=0.1, floor=0.02), "r^2 - floor of DiagonalNoise", "-0.0"),
    "endless layers": (lambda: LSTMUpdate(2, features=2, num_layers=2**63), "num_layers", "at most 1000", f"{2**63}"),
}
WRONG_TYPES = {
    "dt": (lambda: UnicycleMotion(torch.tensor(0.1)), "dt", "Tensor"),
    "error of a sensor": (lambda: KalmanFilter(**PARTS, sensor_error=1.0), "sensor_error is a FadingBias", "float"),
    "a class": (lambda: KalmanFilter(**PARTS, sensor_error=FadingBias), "sensor_error is a FadingBias", "FadingBias"),
    "visibility": (lambda: linear_filter("UKF", visibility=Select([0])), "visibility is a Visibility", "Select"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED)
def test_refused(case):
    refuses(*case)


@pytest.mark.parametrize("case", WRONG_TYPES.values(), ids=WRONG_TYPES)
def test_wrong_types(case):
    refuses(*case, error=TypeError)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_covariances_that_are_right_pass(scale, dtype):
    """Accepts covariances of any unit, singular, and with the rounding of a product in their own precision."""
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(6, 3, generator=generator, dtype=dtype) * torch.logspace(-3, 3, 6, dtype=dtype).unsqueeze(-1)
    cov = scale * (root @ root.mT)
    assert MomentPrior(cov[0], cov).cov.equal(cov)
    one = torch.eye(6, dtype=dtype)
    KalmanFilter(one, one, process_noise_cov=0 * one, noise_cov=0 * cov, mean=cov[0], cov=cov)


def test_constants_without_values_pass():
    """On "meta" there is nothing to look at; a copy, a pickle and a state dict are not checked again."""
    with torch.device("meta"):
        prior = GaussianPrior([0.0], [1.0], ensemble_size=4)
        DEnKF.paper(state_dim=3, observation_dim=2)
        KalmanFilter(
            torch.eye(2),
            torch.eye(2),
            process_noise_cov=torch.eye(2),
            noise_cov=torch.eye(2),
            mean=torch.zeros(2),
            cov=torch.eye(2),
        )
    assert prior.std.is_meta
    kf = KalmanFilter(**PARTS)
    for other in (copy.deepcopy(kf), pickle.loads(pickle.dumps(kf))):
        assert other.state_dict().keys() == kf.state_dict().keys()
        td = other.initialise(TensorDict({"observation": ONE}))
        assert other.step(td.clone())["belief", "mean"].equal(kf.step(td.clone())["belief", "mean"])
