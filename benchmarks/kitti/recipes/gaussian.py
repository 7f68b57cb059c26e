"""The baselines that carry mean and covariance: dEKF and Backprop-KF."""

from __future__ import annotations

from collections import OrderedDict

import torch

from benchmarks.kitti.recipes._base import KITTIRecipe, register
from benchmarks.kitti.streams import LONGEST
from torch_denkf.applications.car.modules.pairs import ClonedPrior, ClonedTransition
from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.modules import (
    CholeskyNoise,
    DiagonalNoise,
    EKFAnalysis,
    EKFTransition,
    GaussianAround,
    ScaledNoise,
    SubModel,
)


class _Gaussian(KITTIRecipe):
    """Base of filters with known motion of the pose, which is corrected by its correlation with the velocities.

    Inflation multiplies Q and R, so that the gain stays as trained. The analysis' own inflation would also multiply the
    variance of the unobserved pose in every step, without bound.
    """

    def modules(self):
        motion = ClonedTransition(self.transition(torch.zeros_like))
        process_noise = ScaledNoise(self.process_noise())
        return OrderedDict(
            noise=ScaledNoise(self.noise()),
            transition=EKFTransition(motion, UnicycleNoise(process_noise, self.facts.dt)),
            analysis=EKFAnalysis(self.observation(history_key=None), observed_key=("forecast", "observed")),
        )

    def process_noise(self) -> SubModel:
        """Returns Q of (v, theta_dot) from their mean; an infinite scale removes the rest of the state."""
        size = 5 + 2 * (LONGEST - 1)
        loc, scale = torch.zeros(size), torch.full((size,), torch.inf)
        loc[3:5], scale[3:5] = self.facts.loc, self.facts.scale
        keys = {"in_key": ("belief", "mean"), "out_key": ("forecast", "noise")}
        return DiagonalNoise(2, r=self.unit, in_features=size, loc=loc, scale=scale, **keys)

    def initial(self, std, state_key):
        return ClonedPrior(GaussianAround(std, state_key=state_key), LONGEST - 1)


@register
class DEKF(_Gaussian):
    """Differentiable extended Kalman filter (Kloss et al. 2021), Jacobians through the known motion."""


@register
class BKF(_Gaussian):
    """Backprop-KF (Haarnoja et al. 2016): R from the frame, Q a learned constant; the pose's motion is linearised."""

    def process_noise(self):
        return CholeskyNoise(2, r=self.unit, in_key=("belief", "mean"), out_key=("forecast", "noise"))
