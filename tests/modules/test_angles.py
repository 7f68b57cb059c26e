"""Readings that are angles. Oracle: the same problem turned by half a circle, where nothing wraps, in plain numbers."""

import math

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.functional.localisation import Neighbours
from torch_denkf.functional.manifolds import Circle, Euclidean
from torch_denkf.modules import (
    EnsembleAnalysis,
    GaussianLikelihood,
    KalmanAnalysis,
    LearnedLikelihood,
    LocalEnsembleAnalysis,
)

pytestmark = pytest.mark.usefixtures("float64")

E, S, OBS = 12, 3, 2
SPACE = Circle() * Euclidean(1)
SCHEMES = ["sensor", "perturbed", "etkf", "sakov"]
INFO = [("info", name) for name in ("innovation", "nis", "log_likelihood")]
BELIEF = [("belief", name) for name in ("ensemble", "mean", "var")]


def wrapped(value):
    """Returns the first component, between -pi and pi."""
    return torch.cat([torch.atan2(value[..., :1].sin(), value[..., :1].cos()), value[..., 1:]], -1)


def turned(value):
    """Returns the first component, turned by half a circle."""
    return wrapped(value - torch.tensor([math.pi, 0.0]))


def ensembles(batch, samples):
    """Returns headings around 3.1, read around -3.1; and the same problem, turned."""
    forecast = 0.3 * torch.randn(*batch, E, S)
    center = torch.tensor([3.1, 1.0])
    predicted = wrapped(forecast[..., :OBS] + center)
    reading = wrapped(0.1 * torch.randn(*batch, E, OBS) + torch.tensor([-3.1, 1.0]))
    reading = reading if samples else wrapped(0.05 * torch.randn(*batch, OBS) + torch.tensor([-3.1, 1.0]))
    assert (predicted[..., 0].amax(-1) - predicted[..., 0].amin(-1) > 6).all(), "the members lie on both sides of pi"
    entries = {"sensor": {"noise": torch.rand(*batch, OBS) + 0.05}, "noise": {"self": torch.randn(*batch, E, OBS)}}
    out = []
    for turn in (lambda value: value, turned):
        td = TensorDict({**entries, "forecast": {"ensemble": forecast, "observation": turn(predicted)}}, batch)
        out.append(td.set(("sensor", "ensemble"), turn(reading)))
    assert out[1]["forecast", "observation"][..., 0].abs().max() < 2
    return out


def assert_same(first, second, keys):
    for key in keys:
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=1e-11, msg=lambda m, k=key: f"{k}: {m}")


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize(("scheme", "samples"), [(s, True) for s in SCHEMES] + [(s, False) for s in SCHEMES[1:]])
def test_ensemble_analysis(scheme, samples, batch):
    here, there = ensembles(batch, samples)
    options = {"inflation": 1.1, "relaxation": 0.2}
    found = EnsembleAnalysis(scheme, reading_space=SPACE, **options)(here.copy())
    assert_same(found, EnsembleAnalysis(scheme, **options)(there.copy()), [*BELIEF, *INFO])
    ignored = EnsembleAnalysis(scheme, **options)(here.copy())
    assert not ignored["belief", "mean"].allclose(found["belief", "mean"], atol=1e-3), "it matters"


@pytest.mark.parametrize("scheme", SCHEMES)
def test_ensemble_analysis_of_observed_components(scheme):
    here, there = ensembles((3,), True)
    for td in (here, there):
        td["observed"] = torch.tensor([[True, True], [False, True], [False, False]])
        td["sensor", "ensemble"] = torch.where(td["observed"].unsqueeze(-2), td["sensor", "ensemble"], torch.nan)
    found = EnsembleAnalysis(scheme, reading_space=SPACE)(here.copy())
    assert_same(found, EnsembleAnalysis(scheme)(there.copy()), [*BELIEF, *INFO])
    assert found["belief", "ensemble"][2].equal(here["forecast", "ensemble"][2])


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("samples", [True, False])
def test_local_analysis(samples, batch):
    here, there = ensembles(batch, samples)
    near = Neighbours(torch.arange(OBS).expand(S, OBS), torch.tensor([[1.0, 0.5], [0.5, 1.0], [0.2, 0.2]]))
    found = LocalEnsembleAnalysis(near, reading_space=SPACE, inflation=1.1)(here.exclude("noise"))
    assert_same(found, LocalEnsembleAnalysis(near, inflation=1.1)(there.exclude("noise")), [*BELIEF, *INFO])


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("samples", [True, False])
def test_kalman_analysis(samples, batch):
    root, matrix = torch.randn(*batch, S, S), torch.eye(S)[:OBS]
    mean = torch.randn(*batch, S).index_fill(-1, torch.tensor([0]), 3.1)
    here, there = ensembles(batch, samples)
    turn = torch.tensor([math.pi, 0.0, 0.0])
    for td, at in ((here, mean), (there, mean - turn)):
        td["forecast"] = TensorDict({"mean": at, "cov": root @ root.mT + torch.eye(S)}, batch)
    keys = {"observation_key": ("sensor", "ensemble")}
    found = KalmanAnalysis(matrix, None, reading_space=SPACE, **keys)(here.copy())
    expected = KalmanAnalysis(matrix, None, **keys)(there.copy())
    expected["belief", "mean"] = expected["belief", "mean"] + turn
    assert_same(found, expected, [("belief", name) for name in ("mean", "cov", "var")] + INFO)
    assert (found["info", "innovation"][..., 0].abs() < 1).all()


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("samples", [True, False])
def test_likelihoods(samples, batch):
    here, there = ensembles(batch, samples)
    learned = LearnedLikelihood(4, OBS, num_cells=(8,), reading_space=SPACE, observation_key=("sensor", "ensemble"))
    plain = LearnedLikelihood(4, OBS, num_cells=(8,), observation_key=("sensor", "ensemble"))
    plain.load_state_dict(learned.state_dict())
    here["sensor", "encoding"] = there["sensor", "encoding"] = torch.randn(*batch, 4)
    for model, oracle in ((GaussianLikelihood(reading_space=SPACE), GaussianLikelihood()), (learned, plain)):
        found = model(here.copy())
        assert_same(found, oracle(there.copy()), [("forecast", "log_likelihood")])
        assert not oracle(here.copy())["forecast", "log_likelihood"].allclose(found["forecast", "log_likelihood"])
