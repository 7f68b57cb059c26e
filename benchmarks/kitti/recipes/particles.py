"""The baselines that carry weighted particles: DPF, dPF-M and dPF-M-lrn."""

from __future__ import annotations

from collections import OrderedDict

import torch

from benchmarks.kitti.recipes._base import Recipe, register
from benchmarks.kitti.streams import LONGEST
from torch_denkf.modules import (
    AroundState,
    ClonedPrior,
    ClonedTransition,
    DiagonalNoise,
    GaussianLikelihood,
    LearnedLikelihood,
    NoisyTransition,
    ParticleAnalysis,
    ResampledTransition,
    WithWeights,
)
from torch_denkf.objectives import MixtureLoss

PARTICLES = 100  # as both papers train with


class _Particles(Recipe):
    """Particles move by the known motion with learned noise of their velocities."""

    resampling, learned = "soft", None

    def modules(self):
        facts, keys = self.facts, {"observed_key": ("forecast", "observed")}
        motion = NoisyTransition(
            self.transition(torch.zeros_like),
            # Of the mean velocities alone: an infinite scale hides the pose.
            DiagonalNoise(
                2,
                r=facts.unit,
                in_features=5,
                loc=torch.cat([torch.zeros(3), facts.loc]),
                scale=torch.cat([torch.full((3,), torch.inf), facts.scale]),
                in_key=("belief", "mean"),
                out_key=("forecast", "noise"),
            ),
            [3, 4],
            before=True,
        )
        modules = OrderedDict()
        if self.learned:
            likelihood = LearnedLikelihood(
                self.encoding,
                2,
                bound=self.learned,
                scale=facts.unit,
                reading_key=("sensor", "ensemble"),
                **keys,
            )
        else:
            modules["noise"] = self.noise()
            likelihood = GaussianLikelihood(**keys)
        modules["transition"] = ResampledTransition(ClonedTransition(motion), self.resampling)
        modules["observation"] = self.observation(history_key=None)
        modules["likelihood"] = likelihood
        modules["analysis"] = ParticleAnalysis()
        return modules

    def initial(self, std, state_key):
        around = AroundState(std, ensemble_size=PARTICLES, state_key=state_key)
        return WithWeights(ClonedPrior(around, LONGEST - 1))

    def loss(self, model):
        return MixtureLoss(model, sensor=0.0, dims=(3, 4), state_scale=self.facts.unit)

    def set_inflation(self, model, factor):
        next(module for module in model.modules() if isinstance(module, ParticleAnalysis)).tempering = factor**-2


@register
class DPF(_Particles):
    """Jonschkowski et al. 2018: learned likelihood, hard resampling in every step."""

    resampling, learned, needs_training = "systematic", "scaled", True


@register
class DPF_M(_Particles):
    """Kloss et al. 2021: Gaussian likelihood, soft resampling."""


@register
class DPF_M_LRN(_Particles):
    """Kloss et al. 2021 with a learned likelihood."""

    learned, needs_training = "clipped", True
