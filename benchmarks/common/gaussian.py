"""The baselines that carry mean and covariance of an arm: dEKF, dUKF and Backprop-KF."""

from __future__ import annotations

from collections import OrderedDict

import torch

from benchmarks.common.arms import ArmRecipe
from torch_denkf.modules import (
    CholeskyNoise,
    EKFAnalysis,
    EKFTransition,
    MappedNoise,
    SubModel,
    UKFAnalysis,
    UKFTransition,
)


class Extended(ArmRecipe):
    """Differentiable extended Kalman filter (Kloss et al. 2021), Jacobians through the learned motion.

    Noise of the rates moves the joints in the same step, as it does the members of an ensemble.
    """

    Analysis: type = EKFAnalysis

    def forecast(self, noise: SubModel) -> SubModel:
        """Mean and covariance a step on; its Jacobian is a constant to the gradient, as in Kloss et al."""
        return EKFTransition(self.transition(), noise, stop_jacobian_gradient=True)

    def modules(self):
        matrix = torch.eye(self.size)[:, self.noisy]
        for rows in self.moved:
            matrix[list(rows), [self.noisy.index(rate) for rate in self.rates]] = 1.0
        return OrderedDict(
            noise=self.noise(),
            transition=self.forecast(MappedNoise(self.process_noise(), matrix)),
            **self.readings(),
            analysis=self.Analysis(self.observation(), observation_key=self.observation_key),
        )


class Unscented(Extended):
    """Differentiable unscented Kalman filter (Kloss et al. 2021)."""

    Analysis = UKFAnalysis

    def forecast(self, noise: SubModel) -> SubModel:
        """Mean and covariance a step on."""
        return UKFTransition(self.transition(), noise)


class Backprop(Extended):
    """Backprop-KF (Haarnoja et al. 2016): R from the frame, Q a learned constant with all covariances."""

    def _process_noise(self) -> SubModel:
        keys = {"in_key": ("belief", "mean"), "out_key": ("forecast", "noise")}
        return CholeskyNoise(len(self.noisy), r=self.process_std, in_features=self.size, **keys)
