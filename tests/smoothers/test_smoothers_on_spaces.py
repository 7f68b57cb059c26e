"""Smoothers of orientations: against plain numbers, a Kalman filter of small angles, and each other."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.beliefs_for_tests import close
from tests.filters.factories import stepwise
from tests.filters.test_spaces import SPACE, B, T, log, make
from tests.smoothers.small_angles import PROCESS, STARTS, assert_small_differences, linear, noise, readings, rotating
from torch_denkf.filters import EKF, UKF
from torch_denkf.functional.manifolds import SO3, Euclidean
from torch_denkf.modules import ConstantNoise, GaussianAround, LearnedTransition, Select
from torch_denkf.smoothers import FixedLag, RTSSmoother

GAUSSIAN = {"EKF": EKF, "UKF": UKF}
SMOOTHED = [("smoothed", "mean"), ("smoothed", "var")]


@pytest.fixture(autouse=True)
def _double(float64):
    return


def numbers():
    """Data, and a motion, sensor, observation and noise of plain numbers, which bend."""
    torch.manual_seed(0)
    data = TensorDict({"pose": torch.randn(B, T, 2), "start": torch.randn(B, T, 2)}, [B, T])
    move = nn.Linear(2, 2, bias=False)
    move.weight.data = torch.tensor([[1.0, 0.4], [-0.3, 0.9]])
    motion = LearnedTransition(nn.Sequential(move, nn.Tanh()), residual=False)
    return data, (motion, None, Select([0, 1])), ConstantNoise([0.3, 0.4], in_key="pose")


@pytest.mark.parametrize("kind", ["EKF", "UKF"])
def test_numbers_as_a_space_change_nothing(kind):
    data, parts, own = numbers()
    outs = []
    for space in (None, Euclidean(2)):
        start = GaussianAround([0.5, 0.6], state_key="start", space=space)
        options = {"process_noise": [0.1, 0.2], "observation_key": "pose", "reading_space": space}
        outs.append(FixedLag(GAUSSIAN[kind](*parts, own, initial=start, **options), 3).sequence(data.clone()))
    close(*outs, [*SMOOTHED, ("smoothed", "cov"), ("smoothed", "age"), ("belief", "cov")], atol=1e-11)


@pytest.mark.parametrize("kind", ["EKF", "UKF"])
def test_small_angles_are_plain_numbers(kind):
    data, flat = readings()
    options, filter = {"process_noise": PROCESS, "observation_key": "pose"}, GAUSSIAN[kind]
    start, plain = (GaussianAround(STARTS, state_key="start", space=space) for space in (SPACE, None))
    on_space = filter(*rotating(), noise(), initial=start, reading_space=SO3(), **options)
    out = FixedLag(on_space, 4).sequence(data.clone())
    expected = FixedLag(filter(*linear(), noise(), initial=plain, **options), 4).sequence(flat)
    assert_small_differences(out, expected, "smoothed", data["start"])


@pytest.mark.parametrize("kind", ["EKF", "UKF"])
def test_online_lag_is_the_smoother(kind):
    """With one step it is the same formula; with more, means move in several steps, which products of angles tell."""
    filter, data = make(kind), log()
    for lag, away, var in ((1, 1e-12, 1e-12), (5, 1e-3, 5e-3)):
        whole, online = RTSSmoother(filter, lag)(data.clone()), FixedLag(filter, lag).sequence(data.clone())
        later, own = online["smoothed"][:, lag:], whole["smoothed"][:, :-lag]
        std = own["var"].sqrt()
        assert (SPACE.minus(later["mean"], own["mean"]).abs() / std).max() < away
        assert (later["var"] / own["var"] - 1).abs().max() < var
        assert (online["smoothed", "age"][:, lag:] == lag).all()


@pytest.mark.parametrize("kind", ["EKF", "UKF"])
def test_steps_and_compiled_steps_are_the_sequence(kind):
    filter, data = FixedLag(make(kind), 3), log()
    data["is_init"] = (torch.arange(T) % 8 == 0).reshape(1, T, 1).expand(B, T, 1).clone()
    out = filter.sequence(data.clone())
    close(stepwise(filter, data.clone()), out, filter.belief_keys, atol=1e-10)
    filter.compile(chunk=2, backend="aot_eager")
    close(filter.sequence(data.clone()), out, [*filter.belief_keys, *SMOOTHED], atol=1e-10)
