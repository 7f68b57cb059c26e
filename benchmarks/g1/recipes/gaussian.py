"""The baselines that carry mean and covariance: dEKF, dUKF and Backprop-KF."""

from __future__ import annotations

from collections import OrderedDict

import torch

from benchmarks.g1.recipes._base import G1Recipe, register
from torch_denkf.modules import (
    CholeskyNoise,
    EKFAnalysis,
    EKFTransition,
    GaussianAround,
    MappedNoise,
    SubModel,
    UKFAnalysis,
    UKFTransition,
)


class _Gaussian(G1Recipe):
    """Noise of the rates moves the joints in the same step, as it does the members of an ensemble."""

    Analysis = EKFAnalysis

    def forecast(self, noise: SubModel) -> SubModel:
        """Mean and covariance a step on; its Jacobian is a constant to the gradient, as in Kloss et al."""
        return EKFTransition(self.transition(), noise, stop_jacobian_gradient=True)

    def modules(self):
        size = self.target.size
        matrix = torch.eye(self.size)[:, self.noisy]
        matrix[range(size), range(size)] = 1.0
        return OrderedDict(
            noise=self.noise(),
            transition=self.forecast(MappedNoise(self.process_noise(), matrix)),
            analysis=self.Analysis(self.observation()),
        )

    def belief(self, std):
        return GaussianAround(std, state_key="start")


@register
class DEKF(_Gaussian):
    """Differentiable extended Kalman filter (Kloss et al. 2021), Jacobians through the learned motion."""


@register
class DEKFActions(DEKF):
    """The same, told the commands."""

    actions = True


@register
class DUKF(_Gaussian):
    """Differentiable unscented Kalman filter (Kloss et al. 2021)."""

    Analysis = UKFAnalysis

    def forecast(self, noise: SubModel) -> SubModel:
        """Mean and covariance a step on."""
        return UKFTransition(self.transition(), noise)


@register
class BKF(_Gaussian):
    """Backprop-KF (Haarnoja et al. 2016): R from the frame, Q a learned constant with all covariances."""

    def _process_noise(self) -> SubModel:
        keys = {"in_key": ("belief", "mean"), "out_key": ("forecast", "noise")}
        return CholeskyNoise(len(self.noisy), r=self.process_std, in_features=self.size, **keys)
