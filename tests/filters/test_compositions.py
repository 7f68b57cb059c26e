"""Every pair of features, through every way to run a filter: the oracle is one step after the other."""

from functools import partial
from itertools import combinations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.composed import FEATURES, B, E, ReplayedFrames, S, T, compose, frames_for
from tests.filters.factories import assert_equal, linear_with
from torch_denkf.modules import VectorSensor
from torch_denkf.transforms import DEnKFTransform

BELIEF = [("belief", name) for name in ("ensemble", "mean", "var")]
PAIRS = [pair for pair in combinations(FEATURES, 2) if set(pair) != {"flipout", "dropout"}]
close = partial(assert_equal, atol=1e-10)  # float64: rounding of a few steps


def stepped(filter, frames, carry=None):
    """Runs ``filter.step`` over ``frames``; rows with ``is_init`` are reset, the first row starts from ``carry``."""
    rows, out = frames.unbind(1), []
    for t, row in enumerate(rows):
        row = row.copy()
        start = filter.initialise(row.copy())
        if t == 0:
            out.append(start if carry is None else filter.summarise(row.set(BELIEF[0], carry)))
            continue
        row["action"] = rows[t - 1]["action"]
        row[BELIEF[0]] = out[-1][BELIEF[0]]
        row = filter.step(row)
        for key in BELIEF:
            row[key] = torch.where(rows[t]["is_init"].reshape(B, *[1] * (row[key].ndim - 1)), start[key], row[key])
        out.append(row)
    return torch.stack([row.select(*BELIEF) for row in out], 1)


@pytest.mark.parametrize("features", PAIRS, ids=" + ".join)
def test_a_sequence_is_its_steps(float64, features):
    filter, frames = compose(features), frames_for(features)
    filter.draw_noise(frames)
    carry = torch.randn(B, E, S) if "stored carry" in features else None
    expected, data = stepped(filter, frames, carry), frames.copy()
    if carry is not None:  # the stored ensembles, and nothing else of the belief
        data[BELIEF[0]] = expected[BELIEF[0]]
    out = filter.sequence(data)
    close(out, expected, BELIEF)
    assert (out["belief", "mean"][:, 2:] - out["belief", "mean"][:, 1:-1]).abs().amin(-1).min() > 0, "all rows move"


@pytest.mark.parametrize("features", [pair for pair in PAIRS if "stored carry" not in pair], ids=" + ".join)
@pytest.mark.parametrize("way", ["transform", "policy"])
def test_an_environment_gives_the_steps(float64, features, way):
    filter, frames = compose(features), frames_for(features)
    env = ReplayedFrames(frames)
    policy = env.player()
    if way == "policy":
        policy = TensorDictSequential(filter, policy)
        env = TransformedEnv(env, get_env_transforms_from_module(policy))
    else:
        env = TransformedEnv(TransformedEnv(env, InitTracker()), DEnKFTransform(filter))
    env.reset()
    torch.manual_seed(5)
    with torch.no_grad():
        rollout = env.rollout(T, policy, break_when_any_done=False)
    assert rollout["is_init"].equal(frames["is_init"])
    assert rollout["action"].equal(frames["action"])
    torch.manual_seed(5)
    if way == "policy":  # its filter runs in the first step, too
        filter.step(filter.initialise(frames[:, 0].copy()))
    close(rollout, stepped(filter, frames), BELIEF)


@pytest.mark.parametrize("actions", [False, True])
def test_a_window_of_a_policys_data_is_its_steps(float64, actions):
    """Resumed in the middle of an episode, with resets inside and marks as SliceSampler puts them."""
    features = ["resets", "mask on one"] + ["actions"] * actions
    frames, filter = frames_for(features), compose(features)
    filter["analysis"].scheme = "sakov"  # without noise
    env = ReplayedFrames(frames)
    policy = TensorDictSequential(filter, env.player())
    env = TransformedEnv(env, get_env_transforms_from_module(policy))
    with torch.no_grad():
        rollout = env.rollout(T, policy, break_when_any_done=False)
    for begin in range(1, T - 1):
        window = rollout[:, begin:].exclude("belief").copy()
        close(filter.sequence(window.copy()), rollout[:, begin:], BELIEF, atol=1e-12)
        window["is_init"][:, 0] = True  # a slice begins here, no episode
        close(filter.sequence(window), rollout[:, begin:], BELIEF, atol=1e-12)
    following = rollout["next"].copy()  # what torchrl's losses value: the observation after the action
    values = filter.sequence(following)
    for t in range(T - 1):
        rows = ~rollout["next", "done"][:, t].squeeze(-1)
        for key in BELIEF:
            torch.testing.assert_close(values[key][rows, t], rollout[key][rows, t + 1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("way", ["step", "sequence"])
def test_two_sensors_draw_their_own_noise(way):
    torch.manual_seed(0)
    options = {"ensemble_size": 500, "num_cells": (16,), "rate": 0.5, "in_key": "observation"}
    sensors = {name: VectorSensor(2, 2, out_key=(name, "ensemble"), **options) for name in ("first", "second")}
    sensors["second"].load_state_dict(sensors["first"].state_dict())
    filter, frames = linear_with(sensors), TensorDict({"observation": torch.ones(3, 6, 2)}, [3, 6])
    out = filter.sequence(frames) if way == "sequence" else filter.step(filter.initialise(frames[:, 0].copy()))
    samples = [out[name, "ensemble"].reshape(-1, 2)[:, 0] for name in sensors]
    # Five standard errors of a correlation of 1,500 independent pairs.
    assert torch.corrcoef(torch.stack(samples))[0, 1].abs() < 5 / 1500**0.5
