"""What the constructors of filters and their parts refuse: the message names the argument and has its value."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.applications.car import FlowSensor, UnicycleMotion, UnicycleNoise, UnicycleTransition
from torch_denkf.applications.car.modules.member_gain import MemberGain
from torch_denkf.applications.car.modules.unicycle_pose import UnicyclePose
from torch_denkf.baselines.lstm_cell import LSTMUpdate
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.filters import DEnKF, KalmanFilter
from torch_denkf.functional.manifolds import Circle, Flat
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import (
    AroundState,
    CholeskyNoise,
    ConstantNoise,
    DiagonalNoise,
    EnsembleAnalysis,
    FromSensor,
    GaussianAround,
    GaussianPrior,
    ImageSensor,
    KalmanAnalysis,
    LearnedLikelihood,
    LearnedObservation,
    LearnedTransition,
    LinearObservation,
    LinearTransition,
    MappedNoise,
    MomentPrior,
    ScaledNoise,
    Select,
    StochasticMLP,
    UKFTransition,
    VectorSensor,
)
from torch_denkf.modules.particles import ParticleAnalysis, ResampledTransition
from torch_denkf.modules.stochastic import FlipoutLinear

EYE, ZERO, ONE = torch.eye(2), torch.zeros(2), torch.ones(2)
NAN, INF = float("nan"), float("inf")
ASYMMETRIC = torch.tensor([[1.0, 0.5], [0.0, 1.0]])
INDEFINITE = torch.tensor([[1.0, 2.0], [2.0, 1.0]])
BESIDE_ZERO = torch.tensor([[1.0, 0.1], [0.1, 0.0]])
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


KALMAN = [
    ("transition", torch.ones(2, 3), "[2, 3]"),
    ("transition", torch.ones(2), "[2]"),
    ("transition", NAN * EYE, "nan at [0, 0]"),
    ("observation", torch.ones(2, 3), "[2, 3]"),
    ("observation", torch.tensor([[1.0, INF]]), "[1, 2]", "inf"),
    ("mean", torch.zeros(3), "[3]"),
    ("mean", torch.tensor([0.0, NAN]), "nan at [1]"),
    *[
        (name, *case)
        for name in ("process_noise_cov", "cov", "noise_cov")
        for case in (
            (-EYE, "-1.0 at [0]"),
            (NAN * EYE, "nan"),
            (ASYMMETRIC, "symmetric", "0.5 at [0, 1]"),
            (INDEFINITE, "positive semi-definite", "-1"),
            (BESIDE_ZERO, "0.1", "zero next to a variance of zero"),
            (torch.eye(3), "[3, 3]"),
        )
    ],
    ("control", torch.ones(3, 1), "[3, 1]"),
    ("control", NAN * torch.ones(2, 1), "nan"),
    ("reading_space", Circle(), "2 rows of matrix"),
]


@pytest.mark.parametrize("case", KALMAN, ids=lambda case: f"{case[0]}-{case[2]}")
def test_kalman_filter(case):
    name, value, *words = case
    if name == "observation" and value.shape == (1, 2):
        parts, words = {**PARTS, "noise_cov": torch.eye(1)}, ["inf at [0, 1]"]
    else:
        parts = PARTS
    refuses(lambda: KalmanFilter(**{**parts, name: value}), name, *words)


@pytest.mark.parametrize(
    ("noises", "words"),
    [
        ({"noise": [1.0, -2.0]}, "-2.0 at \\[1\\]"),
        ({"noise": [1.0, 1.0, 1.0]}, "noise .*\\[3\\]"),
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


NET = nn.Linear(2, 2)
REFUSED = {
    "moments": (lambda: MomentPrior(ZERO, -EYE), "cov", "-1.0"),
    "moments, a matrix": (lambda: MomentPrior(EYE, EYE), "mean", "[2, 2]"),
    "around": (lambda: GaussianAround([NAN]), "std", "nan"),
    "transition, not square": (lambda: LinearTransition(torch.ones(2, 3), EYE), "matrix", "[2, 3]"),
    "transition, noise": (lambda: LinearTransition(EYE, INDEFINITE), "noise", "-1"),
    "analysis, one row": (lambda: KalmanAnalysis(ONE, ONE), "matrix", "[2]"),
    "analysis, inflation": (lambda: KalmanAnalysis(EYE, ONE, inflation=-1), "inflation", "-1"),
    "inflation -1": (lambda: EnsembleAnalysis(inflation=-1), "inflation", "got -1"),
    "inflation 0": (lambda: EnsembleAnalysis(inflation=0.0), "inflation", "got 0.0"),
    "inflation nan": (lambda: EnsembleAnalysis(inflation=NAN), "inflation", "got nan"),
    "relaxation 2": (lambda: EnsembleAnalysis(relaxation=2), "relaxation", "at most 1", "got 2"),
    "relaxation -0.1": (lambda: EnsembleAnalysis(relaxation=-0.1), "relaxation", "got -0.1"),
    "taper": (lambda: EnsembleAnalysis("sakov", taper=(NAN * EYE, EYE)), "state's taper", "nan at [0, 0]"),
    "circular": (lambda: Flat(2, circular=[-1]), "circular", "got -1"),
    "E = -3": (lambda: GaussianPrior([0.0], [1.0], ensemble_size=-3), "ensemble_size", "got -3"),
    "E = 1": (lambda: AroundState([1.0], ensemble_size=1), "ensemble_size", "got 1"),
    "prior's mean": (lambda: GaussianPrior([NAN], [1.0]), "mean", "nan at [0]"),
    "prior's std": (lambda: GaussianPrior([0.0], [INF]), "std", "inf at [0]"),
    "sensor's dims": (lambda: FromSensor([2], [0.0, 0.0], [1.0, 1.0]), "dims", "got 2"),
    "dt nan": (lambda: UnicycleTransition(NET, dt=NAN), "dt", "got nan"),
    "dt negative": (lambda: UnicycleMotion(-0.1), "dt", "got -0.1"),
    "dt of noise": (lambda: UnicycleNoise(CholeskyNoise(2), INF), "dt", "got inf"),
    "dt of a pose": (lambda: UnicyclePose(NAN), "dt", "got nan"),
    "dt of flow": (lambda: FlowSensor(dt=0.0), "dt", "got 0.0"),
    "scale 0": (lambda: UnicycleTransition(NET, 0.1, scale=[1.0, 0.0]), "scale", "0.0 at [1]"),
    "loc nan": (lambda: LearnedTransition(NET, loc=[NAN, 0.0]), "loc", "nan at [0]"),
    "scale -1": (lambda: LearnedObservation(NET, scale=[-1.0, 1.0]), "scale", "-1.0 at [0]"),
    "observation": (lambda: LinearObservation([[INF]]), "matrix", "inf at [0, 0]"),
    "select": (lambda: Select([-1]), "dims", "got -1"),
    "rate 0.001": (lambda: StochasticMLP(2, 2, rate=0.001), "rate", "0.001"),
    "rate nan": (lambda: StochasticMLP(2, 2, rate=NAN), "rate", "nan"),
    "no cells": (lambda: StochasticMLP(2, 2, [0]), "num_cells", "got 0"),
    "posterior": (lambda: FlipoutLinear(2, 2, posterior_std=0.0), "posterior_std", "got 0.0"),
    "sensor's E": (lambda: VectorSensor(2, 2, ensemble_size=0), "ensemble_size", "got 0"),
    "pixel scale": (lambda: ImageSensor(2, image_shape=(1, 16, 16), pixel_scale=[0.0]), "pixel_scale", "0.0"),
    "noise r": (lambda: DiagonalNoise(2, r=INF), "r of DiagonalNoise", "inf"),
    "noise floor": (lambda: DiagonalNoise(2, r=0.1, floor=0.02), "r^2 - floor of DiagonalNoise", "-0.0"),
    "constant r": (lambda: ConstantNoise([0.1, INF]), "r", "inf at [1]"),
    "factor": (lambda: ScaledNoise(ConstantNoise([1.0]), NAN), "factor", "got nan"),
    "gain": (lambda: MemberGain([INF]), "std", "inf at [0]"),
    "mapped": (lambda: MappedNoise(ConstantNoise([1.0]), ONE), "matrix", "[2]"),
    "sigma points": (lambda: UKFTransition(LearnedTransition(NET), CholeskyNoise(2), kappa=NAN), "kappa", "nan"),
    "tempering": (lambda: ParticleAnalysis(tempering=-1.0), "tempering", "got -1.0"),
    "alpha": (lambda: ResampledTransition(LearnedTransition(NET), "soft", alpha=1.5), "alpha", "got 1.5"),
    "epsilon": (lambda: ResampledTransition(LearnedTransition(NET), epsilon=0.0), "epsilon", "got 0.0"),
    "iterations": (lambda: ResampledTransition(LearnedTransition(NET), iterations=0), "iterations", "got 0"),
    "ess": (lambda: ResampledTransition(LearnedTransition(NET), ess_threshold=NAN), "ess_threshold", "got nan"),
    "likelihood": (lambda: LearnedLikelihood(2, 2, scale=0.0), "scale", "got 0.0"),
    "memory": (lambda: LSTMUpdate(2, features=2, hidden_size=0), "hidden_size", "got 0"),
    "endless layers": (lambda: LSTMUpdate(2, features=2, num_layers=2**63), "num_layers", "at most 1000", f"{2**63}"),
    "ceiling": (lambda: KalmanFilter(**PARTS, variance_ceiling=-1.0), "variance_ceiling", "got -1.0"),
    "Table I": (lambda: DEnKF.paper(state_dim=2, observation_dim=2, ensemble_size=-1), "ensemble_size", "got -1"),
}


@pytest.mark.parametrize("case", REFUSED.values(), ids=REFUSED)
def test_refused(case):
    refuses(*case)


WRONG_TYPES = {
    "inflation": (lambda: EnsembleAnalysis(inflation="1"), "inflation", "'1'"),
    "relaxation": (lambda: EnsembleAnalysis(relaxation=None), "relaxation", "None"),
    "E": (lambda: GaussianPrior([0.0], [1.0], ensemble_size=8.0), "ensemble_size", "8.0"),
    "dt": (lambda: UnicycleTransition(NET, dt=torch.tensor(0.1)), "dt", "Tensor"),
    "dims": (lambda: Select([0.5]), "dims", "0.5"),
    "error of a sensor": (lambda: KalmanFilter(**PARTS, sensor_error=1.0), "sensor_error is a FadingBias", "float"),
    "error of an EKF's": (lambda: linear_filter("EKF", sensor_error=1.0), "sensor_error is a FadingBias", "float"),
    "a class": (lambda: KalmanFilter(**PARTS, sensor_error=FadingBias), "sensor_error is a FadingBias", "FadingBias"),
    "visibility": (lambda: linear_filter("UKF", visibility=Select([0])), "visibility is a Visibility", "Select"),
}


@pytest.mark.parametrize("case", WRONG_TYPES.values(), ids=WRONG_TYPES)
def test_wrong_types(case):
    refuses(*case, error=TypeError)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_covariances_that_are_right_pass(scale, dtype):
    """Of any unit, singular, and with the rounding of a product in their own precision."""
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
