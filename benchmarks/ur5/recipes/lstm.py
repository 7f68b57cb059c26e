"""The baseline without a model: a recurrent network on the sensor's readings."""

from __future__ import annotations

from collections import OrderedDict

from benchmarks.common.arms import AtRest
from benchmarks.ur5.demos import STATE
from benchmarks.ur5.recipes._base import INITIAL, UR5Recipe, register
from torch_denkf.filters import LSTMFilter
from torch_denkf.modules import GaussianAround
from torch_denkf.modules.recurrent import with_memory
from torch_denkf.objectives import GaussianLoss

HIDDEN = 128


@register
class LSTM(UR5Recipe):
    """Reads encoding and reading, and in the first step where the arm began, which all others are told as well."""

    bias = False

    def modules(self):
        facts = self.facts
        whole = LSTMFilter(
            None,
            features=self.encoding,
            state_dim=STATE,
            initial=GaussianAround(INITIAL * facts.scale),
            loc=facts.loc,
            scale=facts.scale,
            hidden_size=HIDDEN,
            observation_dim=self.preset.dim,
            observation_loc=self.sensor.loc,
            observation_scale=self.sensor.scale,
            extra_keys=("hint",),
            extra_features=STATE + 1,
        )
        return OrderedDict((name, whole[name]) for name in ("transition", "lstm"))

    def belief(self, std, state_key):
        # Of ten numbers: it has no use for rates.
        return with_memory(AtRest(GaussianAround(std[:STATE], state_key=state_key), STATE, STATE, state_key), HIDDEN)

    def loss(self, model):
        return GaussianLoss(model, transition=0.0, sensor=0.0, dims=self.dims, state_scale=self.unit)

    def set_inflation(self, model, factor):
        model["lstm"].inflation = factor
