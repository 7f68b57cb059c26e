"""The baseline that carries weighted particles: dPF-M."""

from __future__ import annotations

from benchmarks.common.recipes import Particles
from benchmarks.g1.recipes._base import G1Recipe, register
from torch_denkf.modules import AroundState, NoisyTransition
from torch_denkf.modules.particles import with_weights


@register
class DPF_M(Particles, G1Recipe):
    """Kloss et al. 2021: Gaussian likelihood, soft resampling. Particles move by the learned motion."""

    bias = False  # a hundred particles do not fill seven dimensions more

    @property
    def members(self):
        return self.particles

    def noisy_motion(self):
        return NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True)

    def belief(self, std):
        return with_weights(AroundState(std, ensemble_size=self.particles, state_key="start"))
