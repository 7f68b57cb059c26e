"""A stored belief with a past starts a sequence or an episode again. Oracle: the run that it was taken from."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.gaussian_for_tests import linear_filter
from tests.filters.test_contract import fused
from torch_denkf.baselines.iterated import IEnKS
from torch_denkf.smoothers import FixedLag

FILTERS = {
    "ensemble": lambda: FixedLag(linear_denkf(), 3),
    "Kalman": lambda: FixedLag(linear_kalman(), 3),
    "UKF": lambda: FixedLag(linear_filter("UKF"), 2),
    "fused, late": lambda: fused("ensemble", late=True),
    "fused Kalman, late": lambda: fused("Kalman", late=True),
}
every = pytest.mark.parametrize("name", FILTERS)


def run(name):
    torch.manual_seed(0)
    filter = FILTERS[name]()
    frames = filter.draw_noise(TensorDict({"observation": torch.randn(2, 9, 2)}, [2, 9]))
    return filter, frames, filter.sequence(frames.copy())


@every
@pytest.mark.parametrize(("begin", "stored"), [(1, "belief_keys"), (5, "belief_keys"), (4, "carry_keys")])
def test_a_sequence_goes_on_from_the_middle(float64, name, begin, stored):
    """From all that was believed; or from what is carried, of which what was smoothed follows."""
    filter, frames, whole = run(name)
    rest = frames[:, begin:].copy()
    for key in getattr(filter, stored):
        rest[key] = whole[key][:, begin:]
    out = filter.sequence(rest)
    for key in filter.belief_keys:
        torch.testing.assert_close(out[key], whole[key][:, begin:], rtol=0, atol=1e-12)
    assert not torch.equal(whole["smoothed", "mean"][:, -1], whole["belief", "mean"][:, -1])


def test_an_iterated_smoother_goes_on_too(float64):
    plain = linear_denkf()
    parts = [plain["transition"], None, plain["observation"], plain["noise"]]
    filter = IEnKS(*parts, initial=plain.initial, observation_key="observation", process_noise=[0.0, 0.0])
    frames = TensorDict({"observation": torch.randn(2, 8, 2)}, [2, 8])
    whole = filter.sequence(frames.copy())
    rest = frames[:, 4:].copy()
    for key in filter.belief_keys:
        rest[key] = whole[key][:, 4:]
    out = filter.sequence(rest)
    for key in filter.belief_keys:
        torch.testing.assert_close(out[key], whole[key][:, 4:], rtol=0, atol=1e-10)
    # What was smoothed is not carried: of a first element that is all there is, it is the belief itself, of age zero.
    rest = frames[:, 4:].copy()
    for key in filter.carry_keys:
        rest[key] = whole[key][:, 4:]
    alone = filter.sequence(rest)
    for key in filter.belief_keys:
        torch.testing.assert_close(alone[key][:, 1:], whole[key][:, 5:], rtol=0, atol=1e-10)
        own = torch.zeros(2, 1) if key[-1] == "age" else whole["belief", key[-1]][:, 4]
        torch.testing.assert_close(alone[key][:, 0], own.to(alone[key].dtype), rtol=0, atol=1e-12)
