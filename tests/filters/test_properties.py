"""Tests filters for any batch, scale and unit."""

import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from tests.filters.factories import FixedEnsemble, NoisyLinear
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

    def ensemble(self, scheme):
        initial = FixedEnsemble(self.members)
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
@given(SEEDS, BATCHES, GAUSSIAN | ENSEMBLE, SCALES, SCALES)
def test_filters_in_other_units(seed, batch, name, state_scale, scale):
    draw = Draw(seed + 1)
    a, b = draw.units(state_scale, S), draw.units(scale, OBS)
    results = []
    for system in (System(seed), System(seed, a, b)):
        filter = system.gaussian(name) if name[0].isupper() else system.ensemble(name)
        filter = filter.with_options(variance_ceiling=None)
        torch.manual_seed(seed)  # standard normal draws, the same in both units
        results.append(filter.sequence(system.frames(seed, batch)))
    plain, other = results
    # Where nothing is known but the prior, 1e-12 beside 1e12 leaves four digits of sixteen to a difference.
    units = {"mean": a, "ensemble": a, "cov": a * a.unsqueeze(-1), "log_weight": 1.0}
    for key, unit in units.items():
        if plain["belief"].get(key, None) is not None:
            close(other["belief", key] / unit, plain["belief", key], rtol=1e-5, atol=1e-6)
    if name != "particles":
        close(other["info", "nis"], plain["info", "nis"], rtol=1e-5, atol=1e-6)
