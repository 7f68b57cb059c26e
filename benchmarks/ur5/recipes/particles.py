"""The baselines that carry weighted particles: DPF, dPF-M and dPF-M-lrn."""

from __future__ import annotations

from collections import OrderedDict

from torch_denkf.modules import (
    AroundState,
    GaussianLikelihood,
    LearnedLikelihood,
    NoisyTransition,
    ParticleAnalysis,
    ResampledTransition,
    WithWeights,
)
from torch_denkf.objectives import MixtureLoss
from benchmarks.ur5.demos import STATE
from benchmarks.ur5.motion import ERRORS
from benchmarks.ur5.recipes._base import Recipe, register
from benchmarks.ur5.sensors import NEAR, NearForecast

PARTICLES = 100  # as both papers train with


class _Particles(Recipe):
    """Particles move by the learned motion with its learned noise."""

    resampling, learned = "soft", None
    bias = False  # a hundred particles do not fill ten dimensions more

    def modules(self):
        noisy = NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True)
        modules = OrderedDict()
        if not self.learned:
            modules["noise"] = self.noise()
        modules["transition"] = ResampledTransition(noisy, self.resampling)
        modules["near"] = NearForecast(self.preset)
        if self.learned:
            likelihood = LearnedLikelihood(
                self.encoding,
                STATE,
                bound=self.learned,
                scale=ERRORS,
                reading_key=NEAR,
            )
        else:
            likelihood = GaussianLikelihood(sensor_key=NEAR)
        modules["observation"] = self.observation()
        modules["likelihood"] = likelihood
        modules["analysis"] = ParticleAnalysis()
        return modules

    def belief(self, std, state_key):
        return WithWeights(AroundState(std, ensemble_size=PARTICLES, state_key=state_key))

    def loss(self, model):
        return MixtureLoss(model, sensor=0.0, dims=range(STATE), state_scale=ERRORS)

    def set_inflation(self, model, factor):
        model["analysis"].tempering = factor**-2


@register
class DPF(_Particles):
    """Jonschkowski et al. 2018: learned likelihood, hard resampling in every step."""

    resampling, learned = "systematic", "scaled"


@register
class DPF_M(_Particles):
    """Kloss et al. 2021: Gaussian likelihood, soft resampling."""


@register
class DPF_M_LRN(_Particles):
    """Kloss et al. 2021 with a learned likelihood."""

    learned = "clipped"
