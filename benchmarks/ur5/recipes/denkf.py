"""The differentiable ensemble Kalman filter."""

from __future__ import annotations

from collections import OrderedDict

import torch
from torch import Tensor

from benchmarks.ur5.demos import JOINTS, STATE
from benchmarks.ur5.recipes._base import UR5Recipe, register
from benchmarks.ur5.sensors import NEAR, NearForecast
from torch_denkf.modules import AroundState, EnsembleAnalysis, NoisyTransition

ARM = [index for index in range(STATE) if index != JOINTS - 1]  # what the gripper's opening says nothing about
ARM_TAPER, PLACE_TAPER = 0.7, 0.8  # of joints among each other, and with the place: chosen on the validation demos


def localisation(size: int) -> tuple[Tensor, Tensor]:
    """Factors on the covariances of a state of ``size`` and the ten readings, and of the readings.

    128 members show correlations of 0.09 where there are none. What one joint's reading says of another, and all of
    them of the place, goes through the kinematics alone; the gripper's opening has nothing to do with the others.
    Rates, accelerations and biases go with their joint.
    """
    readings = torch.eye(STATE)
    for row in ARM:
        for column in ARM:
            places = (row >= JOINTS) + (column >= JOINTS)
            readings[row, column] = 1.0 if row == column or places == 2 else PLACE_TAPER if places else ARM_TAPER
    return torch.cat([readings, readings[:JOINTS], readings[:JOINTS], readings])[:size], readings


@register
class DEnKF(UR5Recipe):
    """The differentiable ensemble Kalman filter; innovations are those of the sensor's samples.

    Attributes:
        scheme: of the update: trained with ``"sensor"``, it may be run with another one on the samples' mean.
        factors: whether covariances are weakened as :func:`localisation` has it.
        threshold: of the localisation by significance; ``None`` for none.
    """

    scheme, factors = "sensor", True
    threshold: float | None = None

    def modules(self):
        return OrderedDict(
            noise=self.noise(),
            transition=NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True),
            near=NearForecast(self.preset),
            observation=self.observation(),
            analysis=EnsembleAnalysis(
                self.scheme,
                taper=localisation(self.size) if self.factors else None,
                localisation=None if self.threshold is None else "significance",
                threshold=self.threshold or 3.0,
                observation_key=NEAR,
            ),
        )

    def belief(self, std, state_key):
        return AroundState(std, ensemble_size=self.ensemble_size, state_key=state_key)

    def loss(self, model):
        loss = self.ensemble_loss(model)
        loss.set_keys(state="motion_and_bias")
        return loss
