"""The check of analyses: the library's pass it, and an analysis with one mistake fails on that."""

import pytest
import torch
from tensordict.nn import TensorDictSequential
from torch import nn

from torch_denkf.diagnosis import check_analysis
from torch_denkf.functional import analyse
from torch_denkf.functional.moments import ensemble_mean, ensemble_var
from torch_denkf.modules import (
    EKFAnalysis,
    EnsembleAnalysis,
    GaussianLikelihood,
    KalmanAnalysis,
    LinearObservation,
    LocalEnsembleAnalysis,
    UKFAnalysis,
    Update,
)
from torch_denkf.modules.particles import ParticleAnalysis

H = torch.eye(2, 3)
OURS = {
    "sensor": (EnsembleAnalysis("sensor"), {"samples": True}),
    "perturbed": (EnsembleAnalysis("perturbed"), {}),
    "etkf": (EnsembleAnalysis("etkf"), {}),
    "etkf of samples": (EnsembleAnalysis("etkf"), {"samples": True}),
    "rotated": (EnsembleAnalysis("etkf", rotate=True, covariance=True), {"members": 500}),
    "sakov": (EnsembleAnalysis("sakov"), {"tolerance": 0.2}),
    "local": (LocalEnsembleAnalysis(torch.ones(3, 1)), {"observation_dim": 1, "members": 200}),
    "kalman": (KalmanAnalysis(H, None, observation_key=("sensor", "ensemble")), {}),
    "ekf": (EKFAnalysis(LinearObservation(H)), {}),
    "ukf": (UKFAnalysis(LinearObservation(H)), {}),
}
EXACT = ("etkf", "etkf of samples", "rotated", "local", "kalman", "ekf", "ukf")


@pytest.mark.parametrize("name", OURS)
def test_the_librarys_analyses_pass(name):
    before = torch.get_rng_state()
    analysis, options = OURS[name]
    off = check_analysis(analysis, **options)
    assert torch.get_rng_state().equal(before)
    expected = {"mean", "var", "gain", "nis", "where nothing is observed: mean", "where one row is observed: mean"}
    assert expected <= off.keys()
    if name in EXACT:
        assert max(off.values()) < 1e-3


def test_particles_pass():
    likelihood = GaussianLikelihood()
    update = TensorDictSequential(likelihood, ParticleAnalysis(likelihood))
    off = check_analysis(update, members=20_000)
    assert {"mean", "nis", "gain", "covariance of the ensemble"} <= off.keys()


class Own(Update):
    """A right analysis, as the how-to has it, and what can go wrong in it."""

    noise_names = ("",)

    def __init__(self, mistake=None):
        reads = [("forecast", "ensemble"), ("forecast", "observation"), ("sensor", "ensemble"), ("sensor", "noise")]
        writes = [("belief", name) for name in ("ensemble", "mean", "var")]
        writes += [("info", name) for name in ("innovation", "nis", "log_likelihood")]
        super().__init__(nn.Identity(), reads, writes, optional_keys=[] if mistake == "no mask" else ["observed"])
        self.mistake, self.reading_keys = mistake, self.in_keys[:0] if mistake == "nameless" else self.in_keys[2:]

    def draw_noise(self, batch_size, *, members=None, observation_dim=None, rows=None, dtype=None, device=None, **_):
        members = rows if self.mistake == "noise" else members
        if members is None:
            return None
        return torch.randn(*batch_size, members, observation_dim, dtype=dtype, device=device)

    def noise_sizes(self, forecast, predicted, *_):
        sizes = {"members": forecast.shape[-2], "observation_dim": predicted.shape[-1]}
        return {**sizes, "rows": sizes["members"]} if self.mistake == "noise" else sizes

    def compute(self, forecast, predicted, reading, variance, observed=None, *, noise):
        if self.mistake == "std":
            variance = variance.sqrt()
        if self.mistake == "in place":
            forecast.add_(0.5)
        if self.mistake == "no gradient":
            forecast, predicted, reading = forecast.detach(), predicted.detach(), reading.detach()
        if self.mistake == "own seed":
            noise = torch.randn(noise.shape, generator=GENERATOR)
        if self.mistake == "batch":
            forecast = forecast - forecast.mean(tuple(range(forecast.ndim - 1))) + forecast.mean(-2, keepdim=True)
        scheme = "perturbed" if self.mistake != "no perturbation" else "etkf"
        result = analyse(
            forecast,
            predicted,
            reading,
            variance,
            scheme=scheme,
            observed=observed,
            perturbation=noise if scheme == "perturbed" else None,
        )
        ensemble = result.ensemble
        if self.mistake == "inflated":
            ensemble = ensemble_mean(ensemble).unsqueeze(-2) + 1.2 * (ensemble - ensemble_mean(ensemble).unsqueeze(-2))
        nis = result.nis.sqrt() if self.mistake == "nis" else result.nis
        mean = ensemble_mean(forecast if self.mistake == "mean of the forecast" else ensemble)
        return ensemble, mean, ensemble_var(ensemble), result.innovation, nis, result.log_likelihood


GENERATOR = torch.Generator()


def test_an_analysis_of_ones_own_passes():
    assert check_analysis(Own())["mean"] < 0.05


@pytest.mark.parametrize(
    ("mistake", "said"),
    [
        ("std", "mean is off"),
        ("inflated", "var is off"),
        ("nis", "nis is off"),
        ("mean of the forecast", "mean of the ensemble is off"),
        ("batch", "mean is off"),
        ("in place", "changed in place"),
        ("no gradient", "no gradient by the reading"),
        ("no mask", "the mask 'observed', read"),
        ("nameless", "named in reading_keys"),
        ("noise", "draw_noise of Own"),
        ("own seed", "same seed"),
    ],
)
def test_a_mistake_is_named(mistake, said):
    with pytest.raises(AssertionError, match=said):
        check_analysis(Own(mistake))
