"""The differentiable ensemble Kalman filter."""

from __future__ import annotations

from collections import OrderedDict

from tensordict.nn import TensorDictSequential

from benchmarks.kitti.recipes._base import HISTORY, KITTIRecipe, register
from benchmarks.kitti.sensors import SAMPLES
from torch_denkf.applications.car import UnicycleMotion
from torch_denkf.applications.car.modules.member_gain import MemberGain
from torch_denkf.applications.car.modules.pairs import with_history
from torch_denkf.applications.car.odometry.filter import velocity_analysis
from torch_denkf.modules import AroundState, EnsembleAnalysis, StochasticMLP


@register
class DEnKF(KITTIRecipe):
    """The differentiable ensemble Kalman filter: innovations correct the velocities, from which the poses follow.

    Attributes:
        size: members; the sensor has as many samples.
        lags: past steps that an innovation also corrects.
    """

    size, lags = SAMPLES, 4

    def modules(self):
        analysis = velocity_analysis(self.lags)
        return OrderedDict(
            noise=self.noise(),
            # Flipout perturbs the last layer's bias, too: process noise that does not depend on the velocity.
            transition=self.transition(StochasticMLP(2, 2, layer="flipout", output_gain=0.1)),
            observation=self.observation(),
            # Most of the sensor's error is constant over a drive: each member has a calibration of its own.
            gain=MemberGain([0.05, 0.02], ensemble_size=self.size, in_key=("forecast", "observation")),
            analysis=TensorDictSequential(analysis, UnicycleMotion(self.facts.dt, history_key=HISTORY, smooth=True)),
        )

    def initial(self, std, state_key):
        return with_history(AroundState(std, ensemble_size=self.size, state_key=state_key), self.lags)

    def loss(self, model):
        return self.ensemble_loss(model)

    def set_inflation(self, model, factor):
        next(module for module in model.modules() if isinstance(module, EnsembleAnalysis)).inflation = factor
