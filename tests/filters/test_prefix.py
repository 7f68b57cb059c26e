"""A name in front of all that a filter writes: two filters side by side, one behind the other. Oracle: each alone."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import TransformedEnv
from torchrl.modules import set_recurrent_mode
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.composed import ReplayedFrames
from tests.filters.factories import random_walk
from tests.filters.test_contract import FILTERS, every_filter, readings
from torch_denkf.transforms import DEnKFTransform

MEAN, VAR = ("belief", "mean"), ("belief", "var")


def named(name, prefix="imu"):
    """Returns a filter of the contract's table, twice: without and with a prefix, under one noise."""
    plain, other = FILTERS[name](), FILTERS[name]()
    other = other.with_options(prefix=prefix)
    frames = plain.draw_noise(readings(3, 6))
    return plain, other, frames


def moved(frames, prefix="imu"):
    """Copies the frames, with the noise under the prefix."""
    out = frames.copy()
    if out.get("noise", None) is not None:
        out[prefix] = TensorDict({"noise": out.pop("noise")}, out.batch_size)
    return out


@every_filter
def test_a_prefix_changes_names_and_nothing_else(float64, name):
    plain, other, frames = named(name)
    expected, out = plain.sequence(frames.copy()), other.sequence(moved(frames))
    assert other.out_keys == [("imu", *key) for key in plain.out_keys]
    for key in plain.out_keys:
        torch.testing.assert_close(out["imu", *key], expected[key], rtol=0, atol=1e-12)
    assert set(out.keys()) == set(moved(frames).keys()) | {"imu"}
    row = frames[:, 2].copy()
    step = plain.step(row.copy().update(expected[:, 1].select(*plain.carry_keys)))
    own = other.step(moved(row).update(out[:, 1].select(*other.carry_keys)))
    for key in plain.out_keys:
        torch.testing.assert_close(own["imu", *key], step[key], rtol=0, atol=1e-12)


def by_hand(readings, q=0.25, r=1.0):
    """Returns a scalar Kalman filter ``[T]``; the first element is its prior."""
    means, m, p = [0.0], 0.0, 1.0
    for y in readings[1:]:
        p += q
        m, p = m + p / (p + r) * (y - m), p * r / (p + r)
        means.append(m)
    return means


def frames_of(first, second):
    frames = TensorDict({"first": first, "second": second}, first.shape[:2])
    frames["is_init"] = torch.zeros(*first.shape[:2], 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    return frames.set("action", torch.zeros(*first.shape[:2], 1))


@pytest.mark.parametrize("way", ["transforms", "policy"])
def test_two_filters_of_one_environment(float64, way):
    torch.manual_seed(0)
    frames = frames_of(torch.randn(2, 6, 1), torch.randn(2, 6, 1))
    filters = [random_walk(observation_key="first"), random_walk(observation_key="second", prefix="imu")]
    env = ReplayedFrames(frames)
    if way == "transforms":
        for filter in filters:
            env = TransformedEnv(env, DEnKFTransform(filter))
        policy = None
    else:
        policy = TensorDictSequential(*filters, ReplayedFrames(frames).player())
        env = TransformedEnv(env, get_env_transforms_from_module(policy))
    with torch.no_grad():
        out = env.rollout(6, policy, break_when_any_done=False)
    for key, source in ((MEAN, "first"), (("imu", *MEAN), "second")):
        for row in range(2):
            expected = by_hand(frames[source][row].flatten().tolist())
            assert out[key][row].flatten().tolist() == pytest.approx(expected, abs=1e-12)
    if way == "policy":
        with set_recurrent_mode(True):
            data = out.select("first", "second", "is_init", "previous", "imu").exclude(("imu", "belief"))
            again = TensorDictSequential(*filters)(data)
        for key in (MEAN, ("imu", *MEAN)):
            torch.testing.assert_close(again[key], out[key], rtol=0, atol=1e-12)


def test_belief_of_another_filter_warns():
    one, two = random_walk(), random_walk()
    row = TensorDict({"observation": torch.ones(1)}, [])
    row = one(row.set(("previous", *MEAN), torch.zeros(1)).set(("previous", "belief", "cov"), torch.eye(1)))
    following = row["next"].set("observation", torch.ones(1))
    with pytest.warns(UserWarning, match="a belief that another filter wrote"):
        two(following.copy())


def test_the_belief_of_one_is_the_reading_of_another(float64):
    torch.manual_seed(0)
    reading = torch.randn(2, 8, 1)
    first, second = random_walk(prefix="inner"), random_walk(observation_key=("inner", *MEAN))
    out = TensorDictSequential(first, second)
    data = TensorDict({"observation": reading}, [2, 8])
    with set_recurrent_mode(True):
        out = out(data)
    for row in range(2):
        inner = by_hand(reading[row].flatten().tolist())
        assert out["inner", "belief", "mean"][row].flatten().tolist() == pytest.approx(inner, abs=1e-12)
        assert out["belief", "mean"][row].flatten().tolist() == pytest.approx(by_hand(inner), abs=1e-12)
