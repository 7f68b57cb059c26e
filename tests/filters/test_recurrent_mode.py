"""torchrl's recurrent mode inside a filter: on for modules that process whole sequences, off inside a step."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import set_recurrent_mode
from torchrl.modules.tensordict_module.rnn import recurrent_mode

from tests.filters.factories import linear_denkf, linear_with

MEAN = ("belief", "mean")


class Smoothed(TensorDictModuleBase):
    """Sums readings over time in recurrent mode, as a recurrent module of torchrl would."""

    def __init__(self):
        super().__init__()
        self.in_keys, self.out_keys = ["raw"], ["observation"]

    def forward(self, tensordict):
        raw = tensordict["raw"]
        return tensordict.set("observation", raw.cumsum(-2) if recurrent_mode() else raw)


class Pushed(TensorDictModuleBase):
    """Moves the forecast by 1, or by 100 in recurrent mode."""

    def __init__(self):
        super().__init__()
        self.in_keys = self.out_keys = [("forecast", "ensemble")]

    def forward(self, tensordict):
        push = 100.0 if recurrent_mode() else 1.0
        return tensordict.set(("forecast", "ensemble"), tensordict["forecast", "ensemble"] + push)


@pytest.mark.parametrize("mode", [False, True])
def test_recurrent_mode_is_on_for_frames_and_off_for_steps(float64, mode):
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
