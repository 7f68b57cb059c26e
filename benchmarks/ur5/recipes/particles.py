"""The baselines that carry weighted particles: DPF, dPF-M and dPF-M-lrn."""

from __future__ import annotations

from collections import OrderedDict

from benchmarks.common.recipes import Particles
from benchmarks.ur5.recipes._base import UR5Recipe, register
from benchmarks.ur5.sensors import NEAR, NearForecast
from torch_denkf.modules import AroundState, NoisyTransition
from torch_denkf.modules.particles import with_weights


class _Particles(Particles, UR5Recipe):
    """Particles move by the learned motion with its learned noise."""

    bias = False  # a hundred particles do not fill ten dimensions more
    observation_key = NEAR

    def noisy_motion(self):
        return NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True)

    def readings(self):
        return OrderedDict(near=NearForecast(self.preset))

    def belief(self, std, state_key):
        return with_weights(AroundState(std, ensemble_size=self.particles, state_key=state_key))


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
