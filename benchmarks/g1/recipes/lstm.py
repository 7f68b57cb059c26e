"""The baseline without a model: a recurrent network on the sensor's readings."""

from __future__ import annotations

from collections import OrderedDict

from benchmarks.common.arms import AtRest
from benchmarks.g1.recipes._base import G1Recipe, register
from benchmarks.g1.recordings import JOINTS
from torch_denkf.baselines import LSTMFilter
from torch_denkf.baselines.lstm_cell import with_memory
from torch_denkf.modules import GaussianAround
from torch_denkf.objectives import GaussianLoss

HIDDEN = 128


@register
class LSTM(G1Recipe):
    """Reads encoding and reading. It knows no motion, and is trained for longer."""

    bias = False
    longer = 6

    def modules(self):
        size, motion = JOINTS, self.motion
        whole = LSTMFilter(
            None,
            features=self.encoding,
            state_dim=size,
            initial=GaussianAround(self.start),
            loc=motion.loc,
            scale=motion.scale,
            hidden_size=HIDDEN,
            observation_dim=size,
            observation_loc=motion.loc,
            observation_scale=motion.scale,
        )
        return OrderedDict((name, whole[name]) for name in ("transition", "lstm"))

    def _initial(self, std, rates):
        return with_memory(AtRest(GaussianAround(std, state_key="start"), JOINTS, JOINTS, "start"), HIDDEN)

    def loss(self, model):
        return GaussianLoss(model, transition=0.0, sensor=0.0, dims=self.dims, state_scale=self.unit)

    def set_inflation(self, model, factor):
        model["lstm"].inflation = factor
