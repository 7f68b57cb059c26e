"""Tests which output of a transition is the forecast of which belief entry, and modules that overwrite each other."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.beliefs_for_tests import BELIEF, ENSEMBLE, close
from tests.filters.factories import NoisyLinear, linear_denkf, linear_system, linear_with
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis


class Reversed(NoisyLinear):
    """Writes another entry before the forecast."""

    def __init__(self, matrix, control=None):
        super().__init__(matrix, control=control)
        self.out_keys = [("forecast", "speed"), ("forecast", "ensemble")]

    def compute(self, state, action=None, *, noise):
        moved = super().compute(state, action, noise=noise)
        return (moved - state).norm(dim=-1), moved


def test_forecast_is_found_by_its_name(float64):
    F, _, _, _ = linear_system()
    plain = linear_denkf(update_at_reset=True)
    other = linear_with({"transition": Reversed(F)}, update_at_reset=True)
    assert other.structure.forecast_of == {ENSEMBLE: ("forecast", "ensemble")}
    frames = TensorDict({"observation": torch.randn(3, 6, 2)}, [3, 6])
    out = other.sequence(frames.copy())
    close(out, plain.sequence(frames.copy()), BELIEF)
    assert (out["forecast", "speed"][:, 0] == 0).all()
    assert (out["forecast", "speed"][:, 1:] > 0).all()


def test_ambiguous_forecast_raises_without_forecast_keys():
    F, *_ = linear_system()

    class Two(NoisyLinear):
        def __init__(self):
            super().__init__(F)
            self.out_keys = [("a", "ensemble"), ("forecast", "ensemble")]

        def compute(self, state, *, noise):
            moved = super().compute(state, noise=noise)
            return moved, moved

    with pytest.raises(ValueError, match="forecast_keys="):
        linear_with({"transition": Two()})
    linear_with({"transition": Two()}, forecast_keys={ENSEMBLE: ("forecast", "ensemble")})
    with pytest.raises(ValueError, match="forecast_keys has"):
        linear_with({"transition": Two()}, forecast_keys={ENSEMBLE: ("nowhere", "ensemble")})


def test_module_that_overwrites_an_unread_entry_raises():
    again = EnsembleAnalysis("etkf", observation_key="observation")
    with pytest.raises(ValueError, match=r"over what 'analysis' .* before any module has read it"):
        linear_with({**dict(linear_denkf().module.named_children()), "again": again})
    noise = ConstantNoise([1.0, 1.0], in_key="observation", out_key=("observation", "noise"))
    analysis = EnsembleAnalysis("etkf", observation_key="observation", noise_variance_key=("observation", "noise"))
    with pytest.raises(ValueError, match="'observation' is a tensor"):
        linear_with({"noise": noise}, analysis=analysis)
