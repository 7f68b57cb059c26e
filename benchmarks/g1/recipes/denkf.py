"""The differentiable ensemble Kalman filter."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from benchmarks.g1.recipes._base import G1Recipe, register
from benchmarks.g1.recordings import JOINTS
from torch_denkf.modules import AroundState, EnsembleAnalysis, NoisyTransition

TAPER = 0.5  # factor on the covariances of different joints


def localisation(size: int) -> tuple[Tensor, Tensor]:
    """Factors on the covariances of a state of ``size`` and the readings, and of the readings.

    An ensemble shows correlations of joints that are not there. Rates and biases go with their joint.
    """
    readings = torch.where(torch.eye(JOINTS) > 0, 1.0, TAPER)
    return readings.repeat(size // JOINTS, 1), readings


@register
class DEnKF(G1Recipe):
    """The differentiable ensemble Kalman filter; innovations are those of the sensor's samples."""

    def modules(self):
        return OrderedDict(
            noise=self.noise(),
            transition=NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True),
            observation=self.observation(),
            analysis=EnsembleAnalysis("sensor", taper=localisation(self.size)),
        )

    def belief(self, std):
        return AroundState(std, ensemble_size=self.members, state_key="start")

    def loss(self, model):
        loss = self.ensemble_loss(model)
        loss.set_keys(state="padded")
        return loss


@register
class DEnKFActions(DEnKF):
    """Reads the commands, too."""

    actions = True
