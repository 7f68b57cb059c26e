"""The differentiable ensemble Kalman filter."""

from __future__ import annotations

from collections import OrderedDict

from torch_denkf.modules import AroundState, EnsembleAnalysis, NoisyTransition
from torch_denkf.objectives import DEnKFLoss
from ur5_study.recipes._base import Recipe, register
from ur5_study.sensors import NEAR, NearForecast


@register
class DEnKF(Recipe):
    """The differentiable ensemble Kalman filter; innovations are those of the sensor's samples."""

    def modules(self):
        return OrderedDict(
            noise=self.noise(),
            transition=NoisyTransition(self.transition(), self.process_noise(), self.noisy, before=True),
            near=NearForecast(self.preset),
            observation=self.observation(),
            analysis=EnsembleAnalysis("sensor", sensor_key=NEAR),
        )

    def belief(self, std, state_key):
        return AroundState(std, ensemble_size=self.ensemble_size, state_key=state_key)

    def loss(self, model):
        loss = DEnKFLoss(model, sensor=0.0, state_scale=self.state_scale)
        loss.set_keys(state="motion_and_bias" if self.bias else "motion")
        return loss


@register
class DEnKFActions(DEnKF):
    """The same, told where the joints were sent."""

    actions = True


@register
class ADEnKF(DEnKF):
    """Chen, Sanz-Alonso & Willett 2022: the same filter, trained by its readings' likelihood, without the truth."""

    def loss(self, model):
        return DEnKFLoss.ad_enkf(model, detach_every=8)
