"""Tests filters for any batch, precision, scale, order of members and unit."""

import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.filters.factories import FixedEnsemble, NoisyLinear, random_draws
from tests.properties_for_tests import BATCHES, FIXED, SCALES, SEEDS, Draw, close
from torch_denkf.baselines import BackpropKF
from torch_denkf.filters import EKF, UKF, DEnKF, KalmanFilter, ParticleFilter
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianLikelihood,
    LinearObservation,
    MappedNoise,
    MomentPrior,
)
from torch_denkf.modules.particles import with_weights

S, OBS, E, T = 3, 2, 8, 4
GAUSSIAN = st.sampled_from(["KalmanFilter", "EKF", "UKF", "BackpropKF"])
ENSEMBLE = st.sampled_from(["etkf", "sakov", "perturbed", "particles"])


class System:
    """x' = F x + N(0, Q), y = H x + N(0, R), in units of ``a`` for the state and ``b`` for readings."""

    def __init__(self, seed, a=None, b=None, dtype=torch.float64):
        draw = Draw(seed)
        self.a = torch.ones(S, dtype=torch.float64) if a is None else a
        self.b = torch.ones(OBS, dtype=torch.float64) if b is None else b
        values = {
            "F": 0.5 * draw.normal(S, S) * self.a.unsqueeze(-1) / self.a,
            "root": 0.3 * draw.normal(S, S) * self.a.unsqueeze(-1),
            "H": draw.normal(OBS, S) * self.b.unsqueeze(-1) / self.a,
            "r": (0.5 + draw.uniform(OBS)) * self.b,
            "mean": draw.normal(S) * self.a,
            "members": draw.normal(E, S) * self.a,
        }
        for name, value in values.items():
            setattr(self, name, value.to(dtype))
        self.cov = torch.diag(self.a.square()).to(dtype)

    def gaussian(self, name):
        prior = MomentPrior(self.mean, self.cov)
        if name == "KalmanFilter":
            return KalmanFilter(
                self.F,
                self.H,
                process_noise_cov=self.root @ self.root.mT,
                noise_cov=self.r.square().diag(),
                mean=self.mean,
                cov=self.cov,
            )
        unit = ConstantNoise(torch.ones_like(self.mean), in_key=("belief", "mean"), out_key=("forecast", "noise"))
        q, r = MappedNoise(unit, self.root), ConstantNoise(self.r, in_key="observation")
        keys = {"initial": prior, "observation_key": "observation"}
        if name == "BackpropKF":
            return BackpropKF(self.F, None, self.H, r, process_noise_cov=q, **keys)
        return {"EKF": EKF, "UKF": UKF}[name](
            NoisyLinear(self.F), None, LinearObservation(self.H), r, process_noise=q, **keys
        )

    def ensemble(self, scheme, order=None):
        initial = FixedEnsemble(self.members if order is None else self.members[order])
        parts = (NoisyLinear(self.F, self.root), None, LinearObservation(self.H))
        r = ConstantNoise(self.r, in_key="observation")
        if scheme == "particles":
            likelihood = GaussianLikelihood(observation_key="observation")
            return ParticleFilter(*parts, likelihood, noise=r, initial=with_weights(initial), resampling=None)
        analysis = EnsembleAnalysis(scheme, observation_key="observation")
        return DEnKF(*parts, r, analysis, initial=initial)

    def frames(self, seed, batch, steps=T):
        draw = Draw(seed)
        frames = TensorDict({"observation": draw.normal(*batch, steps, OBS) * self.b}, [*batch, steps])
        frames["observed"] = draw.mask(*batch, steps, OBS)
        return frames.set("observation", frames["observation"].to(self.F.dtype))


@FIXED
@given(SEEDS, BATCHES, GAUSSIAN, SCALES, SCALES)
def test_gaussian_filters_in_other_units(seed, batch, name, state_scale, scale):
    draw = Draw(seed + 1)
    a, b = draw.units(state_scale, S), draw.units(scale, OBS)
    results = []
    for system in (System(seed), System(seed, a, b)):
        filter = system.gaussian(name)
        filter = filter.with_options(variance_ceiling=None)
        results.append(filter.sequence(system.frames(seed, batch)))
    plain, other = results
    # Where nothing is known but the prior, 1e-12 beside 1e12 leaves four digits of sixteen to a difference.
    close(other["belief", "mean"] / a, plain["belief", "mean"], rtol=1e-5, atol=1e-6)
    close(other["belief", "cov"] / (a * a.unsqueeze(-1)), plain["belief", "cov"], rtol=1e-5, atol=1e-6)
    close(other["info", "nis"], plain["info", "nis"], rtol=1e-5, atol=1e-6)


@FIXED
@given(SEEDS, BATCHES, ENSEMBLE, SCALES, SCALES)
def test_ensemble_filters_in_other_units(seed, batch, scheme, state_scale, scale):
    draw = Draw(seed + 1)
    a, b = draw.units(state_scale, S), draw.units(scale, OBS)
    results = []
    for system in (System(seed), System(seed, a, b)):
        filter = system.ensemble(scheme)
        filter = filter.with_options(variance_ceiling=None)
        torch.manual_seed(seed)  # standard normal draws, the same in both units
        results.append(filter.sequence(system.frames(seed, batch)))
    plain, other = results
    close(other["belief", "ensemble"] / a, plain["belief", "ensemble"], rtol=1e-5, atol=1e-6)
    if scheme == "particles":
        close(other["belief", "log_weight"], plain["belief", "log_weight"], rtol=1e-5, atol=1e-6)


@FIXED
@given(SEEDS, BATCHES, ENSEMBLE)
def test_members_may_come_in_any_order(seed, batch, scheme):
    system = System(seed)
    order = Draw(seed + 1).order(E)
    frames = system.frames(seed, batch)
    filters = [system.ensemble(scheme), system.ensemble(scheme, order)]
    plain = filters[0].draw_noise(frames.copy(), generator=torch.Generator().manual_seed(seed))
    other = plain.copy()
    other["noise"] = plain["noise"].apply(lambda value: value[..., order, :])
    for filter, row in zip(filters, (plain, other), strict=True):
        random_draws(filter).sequence(row)  # exact ones go through a matrix, and blow up rounding
    close(other["belief", "ensemble"], plain["belief", "ensemble"][..., order, :])
    close(other["belief", "mean"], plain["belief", "mean"])


@FIXED
@given(SEEDS, BATCHES, GAUSSIAN | st.sampled_from(["etkf", "sakov"]))
def test_a_batch_is_its_elements(seed, batch, name):
    """Also of the sums' order: element by element up to rounding."""
    system = System(seed)
    filter = system.gaussian(name) if name[0].isupper() else system.ensemble(name)
    frames = system.frames(seed, batch)
    noise = filter.draw_noise(frames.copy(), generator=torch.Generator().manual_seed(seed))
    flat = noise.reshape(-1, T)
    whole = filter.sequence(noise.copy())["belief", "mean"].reshape(-1, T, S)
    for number in range(len(flat)):
        close(filter.sequence(flat[number].clone())["belief", "mean"], whole[number])


@FIXED
@given(SEEDS, BATCHES, GAUSSIAN | st.sampled_from(["etkf", "sakov", "particles"]), st.sampled_from([1, OBS]))
def test_a_step_that_observes_nothing_is_a_forecast(seed, batch, name, width):
    system = System(seed)
    filter = system.gaussian(name) if name[0].isupper() else system.ensemble(name)
    row = system.frames(seed, batch, 1)[..., 0]
    row["observed"] = torch.zeros(*batch, width, dtype=torch.bool)
    row["observation"] = torch.full_like(row["observation"], torch.nan)
    row = filter.draw_noise(filter.initialise(row), generator=torch.Generator().manual_seed(seed))
    blind, forecast = filter.step(row.clone()), filter.predict(row.clone())
    for key in filter.carry_keys:
        assert blind[key].isfinite().all()
        close(blind[key], forecast[key])
