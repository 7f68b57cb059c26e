"""The baseline without a model: a recurrent network on the sensor's readings."""

from __future__ import annotations

from collections import OrderedDict

from benchmarks.kitti.recipes._base import INITIAL_STD, KITTIRecipe, register
from torch_denkf.applications.car.modules.unicycle_pose import UnicyclePose
from torch_denkf.filters import LSTMFilter
from torch_denkf.modules import GaussianAround
from torch_denkf.modules.recurrent import with_memory
from torch_denkf.objectives import GaussianLoss

HIDDEN = 64  # about as many parameters as the other filters have


@register
class LSTM(KITTIRecipe):
    """Reads encoding, reading and the number of steps that it spans; the pose follows by the known motion."""

    needs_training = True

    def modules(self):
        facts = self.facts
        whole = LSTMFilter(
            None,
            features=self.encoding,
            state_dim=5,
            motion=UnicyclePose(facts.dt),
            initial=GaussianAround(INITIAL_STD),
            loc=facts.loc,
            scale=facts.scale,
            hidden_size=HIDDEN,
            observation_dim=2,
            observation_loc=facts.loc,
            observation_scale=facts.scale,
            extra_keys=("steps",),
            extra_features=1,
        )
        return OrderedDict((name, whole[name]) for name in ("transition", "lstm", "motion"))

    def initial(self, std, state_key):
        return with_memory(GaussianAround(std, state_key=state_key), HIDDEN)

    def loss(self, model):
        return GaussianLoss(model, transition=0.0, sensor=0.0, dims=self.dims, state_scale=self.unit)

    def set_inflation(self, model, factor):
        model["lstm"].inflation = factor
