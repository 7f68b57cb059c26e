"""The baseline that carries weighted particles: dPF-M-lrn."""

from __future__ import annotations

import torch

from benchmarks.common.recipes import Particles
from benchmarks.kitti.recipes._base import KITTIRecipe, register
from benchmarks.kitti.streams import LONGEST
from torch_denkf.applications.car.modules.pairs import ClonedPrior, ClonedTransition
from torch_denkf.modules import AroundState, DiagonalNoise, NoisyTransition
from torch_denkf.modules.particles import with_weights


@register
class DPF_M_LRN(Particles, KITTIRecipe):
    """Kloss et al. 2021 with a learned likelihood; particles move by the known motion, their velocities with noise."""

    learned = "clipped"
    likelihood_keys = {"observed_key": ("forecast", "observed")}  # noqa: RUF012

    def noisy_motion(self):
        facts = self.facts
        noise = DiagonalNoise(
            2,
            r=self.unit,
            in_features=5,
            # A function of the mean velocities alone: an infinite scale removes the pose.
            loc=torch.cat([torch.zeros(3), facts.loc]),
            scale=torch.cat([torch.full((3,), torch.inf), facts.scale]),
            in_key=("belief", "mean"),
            out_key=("forecast", "noise"),
        )
        return ClonedTransition(NoisyTransition(self.transition(torch.zeros_like), noise, [3, 4], before=True))

    def observation(self):
        return super().observation(history_key=None)

    def initial(self, std, state_key):
        around = AroundState(std, ensemble_size=self.particles, state_key=state_key)
        return with_weights(ClonedPrior(around, LONGEST - 1))
