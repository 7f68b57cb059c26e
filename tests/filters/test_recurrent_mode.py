"""torchrl's recurrent mode inside a filter: on for modules that read frames of a sequence, off for its steps."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import set_recurrent_mode
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from tests.filters.factories import linear_denkf, linear_with

MEAN = ("belief", "mean")


class Smoothed(TensorDictModuleBase):
    """Adds up readings in time in recurrent mode, as torchrl's recurrent modules go through a sequence."""

    def __init__(self):
        super().__init__()
        self.in_keys, self.out_keys = ["raw"], ["observation"]

    def forward(self, tensordict):
        raw = tensordict["raw"]
        return tensordict.set("observation", raw.cumsum(-2) if recurrent_mode() else raw)


class Pushed(TensorDictModuleBase):
    """Moves the forecast by one, and by a hundred where it takes its step for a sequence."""

    def __init__(self):
        super().__init__()
        self.in_keys = self.out_keys = [("forecast", "ensemble")]

    def forward(self, tensordict):
        push = 100.0 if recurrent_mode() else 1.0
        return tensordict.set(("forecast", "ensemble"), tensordict["forecast", "ensemble"] + push)


@pytest.mark.parametrize("mode", [False, True])
def test_frames_of_a_sequence_are_one_and_steps_are_not(float64, mode):
    filter = linear_with({"raw": Smoothed(), "transition": linear_denkf()["transition"], "push": Pushed()})
    frames = TensorDict({"raw": torch.randn(3, 6, 2)}, [3, 6])
    with set_recurrent_mode(mode):
        out = filter.sequence(frames.copy())
    torch.testing.assert_close(out["observation"], frames["raw"].cumsum(1))
    row = filter.initialise(out[:, 0].select("raw"))
    for t in range(1, 6):
        row["raw"] = out["observation"][:, t]
        row = filter.step(row)
        torch.testing.assert_close(out[MEAN][:, t], row[MEAN], rtol=0, atol=1e-12)
