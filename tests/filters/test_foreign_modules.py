"""Modules that a filter calls on a TensorDict: with hooks, with a forward of their own, and the noise they find."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import NoisyLinear, linear_denkf, linear_system
from torch_denkf.modules import SubModel
from torch_denkf.running import run_module

ENSEMBLE, FORECAST = ("belief", "ensemble"), ("forecast", "ensemble")


pytestmark = pytest.mark.usefixtures("float64")


def forecasts(filter):
    """Returns the forecast of a step, and that of the second element of a sequence from the same belief."""
    frames = TensorDict({"observation": torch.randn(3, 2, 2)}, [3, 2])
    filter.draw_noise(frames)
    out = filter.sequence(frames.copy())
    row = frames[:, 1].copy().set(ENSEMBLE, out[ENSEMBLE][:, 0])
    return frames, out[ENSEMBLE][:, 0], filter.step(row)[FORECAST], out[FORECAST][:, 1]


@pytest.mark.parametrize("kind", ["before", "after"])
def test_hooks_on_a_sub_model_run(kind):
    filter, (F, *_) = linear_denkf(), linear_system()

    def before(module, args):
        return (args[0].set(ENSEMBLE, args[0][ENSEMBLE] + 2.0),)

    def after(module, args, out):
        return out.set(FORECAST, out[FORECAST] + 2.0)

    if kind == "before":
        filter["transition"].register_forward_pre_hook(before)
    else:
        filter["transition"].register_forward_hook(after)
    _, belief, *found = forecasts(filter)
    expected = (belief + 2.0) @ F.mT if kind == "before" else belief @ F.mT + 2.0
    for value in found:
        torch.testing.assert_close(value, expected)


class OwnForward(NoisyLinear):
    """A sub-model that does something else on a TensorDict than in ``compute``."""

    def forward(self, tensordict):
        tensordict = super().forward(tensordict)
        return tensordict.set(FORECAST, 3.0 * tensordict[FORECAST])


def test_custom_forward_runs_with_its_noise():
    filter, (F, Q, *_) = linear_denkf(), linear_system()
    root = torch.linalg.cholesky(Q)
    filter = filter.with_modules(transition=OwnForward(F, root))
    frames, belief, *found = forecasts(filter)
    expected = 3.0 * (belief @ F.mT + frames["noise", "transition"][:, 1] @ root.mT)
    for value in found:
        torch.testing.assert_close(value, expected)


class Wrapped(SubModel):
    """A transition inside another, in a sub-model with a forward of its own."""

    def __init__(self, inner):
        super().__init__(inner, inner.in_keys, inner.out_keys)

    def parts(self):
        return {"inner": self.module}

    def on_entries(self, entries, call):
        return run_module(self.module, entries, call.part("inner"))

    def forward(self, tensordict):
        return super().forward(tensordict)


def test_noise_of_a_part_inside_is_found_by_its_place_inside():
    filter, (F, Q, *_) = linear_denkf(), linear_system()
    root = torch.linalg.cholesky(Q)
    filter = filter.with_modules(transition=Wrapped(NoisyLinear(F, root)))
    frames, belief, *found = forecasts(filter)
    assert set(frames["noise"].keys()) == {"transition.inner"}
    expected = belief @ F.mT + frames["noise", "transition.inner"][:, 1] @ root.mT
    for value in found:
        torch.testing.assert_close(value, expected)
