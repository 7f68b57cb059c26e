"""Every pair of features, through every way to run a filter: the oracle is one step after the other."""

from itertools import combinations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torchrl.envs import InitTracker, TransformedEnv
from torchrl.modules.utils import get_env_transforms_from_module

from tests.filters.composed import FEATURES, B, E, ReplayedFrames, S, T, compose, frames_for
from tests.filters.factories import NoisyLinear, linear_kalman, linear_system, stepwise
from tests.filters.two_readings_for_tests import parts_of_reading
from torch_denkf.filters import Filter
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LinearObservation, VectorSensor
from torch_denkf.transforms import DEnKFTransform

BELIEF = [("belief", name) for name in ("ensemble", "mean", "var")]
PAIRS = [pair for pair in combinations(FEATURES, 2) if set(pair) != {"flipout", "dropout"}]
every_pair = pytest.mark.parametrize("features", PAIRS, ids=" + ".join)
#: To trace a composition takes dynamo ten seconds: all features at once, and every pair with `make test-all`.
#: Networks with dropout in place of flipout are traced in test_sequence.py and test_compiled.py.
ALL = tuple(feature for feature in FEATURES if feature != "dropout")
all_at_once = pytest.mark.parametrize(
    "features",
    [ALL, *(pytest.param(pair, marks=pytest.mark.slow) for pair in PAIRS)],
    ids=lambda features: "all" if features == ALL else " + ".join(features),
)


def close(first, second, keys, atol=1e-10):  # float64: rounding of a few steps
    for key in keys:
        torch.testing.assert_close(first[key], second[key], rtol=0, atol=atol, msg=lambda m, k=key: f"{k}: {m}")


def stepped(filter, frames, carry=None):
    """All steps of ``frames``, by ``filter.step``; rows with ``is_init`` start anew, the first from ``carry``."""
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


def prepared(features):
    filter, frames = compose(features), frames_for(features)
    filter.draw_noise(frames)
    carry = torch.randn(B, E, S) if "stored carry" in features else None
    return filter, frames, carry


@every_pair
def test_a_sequence_is_its_steps(float64, features):
    filter, frames, carry = prepared(features)
    expected = stepped(filter, frames, carry)
    data = frames.copy() if carry is None else with_carry(frames, expected)
    out = filter.sequence(data)
    close(out, expected, BELIEF)
    assert (out["belief", "mean"][:, 2:] - out["belief", "mean"][:, 1:-1]).abs().amin(-1).min() > 0, "all rows move"


def with_carry(frames, beliefs):
    """Frames with the stored ensembles, and nothing else of the belief."""
    return frames.copy().set(BELIEF[0], beliefs[BELIEF[0]])


@pytest.mark.slow
@all_at_once
def test_compiled_is_eager(float64, features):
    filter, frames, carry = prepared(features)
    data = frames if carry is None else with_carry(frames, stepped(filter, frames, carry))
    expected = filter.sequence(data.copy())
    expected_step = filter.step(expected[:, 3].copy().update(frames[:, 4]))
    filter.compile(chunk=2, backend="eager")
    close(filter.sequence(data.copy()), expected, filter.out_keys)
    close(
        filter.step(expected.exclude(*filter.structure.frame_keys)[:, 3].copy().update(frames[:, 4])),
        expected_step,
        BELIEF,
    )


@every_pair
@pytest.mark.parametrize("way", ["transform", "policy"])
def test_an_environment_gives_the_steps(float64, features, way):
    features = [feature for feature in features if feature != "stored carry"]
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
    rows, carry = frames.unbind(1), None
    if way == "policy":  # its filter runs in the first step, too
        filter.step(filter.initialise(rows[0].copy()))
    out = []
    for t, row in enumerate(rows):
        start = filter.initialise(row.copy())
        if t == 0:
            carry = start
        else:
            now = row.copy().set("action", rows[t - 1]["action"]).set(BELIEF[0], carry[BELIEF[0]])
            carry = filter.step(now)
            for key in BELIEF:
                mask = row["is_init"].reshape(B, *[1] * (carry[key].ndim - 1))
                carry[key] = torch.where(mask, start[key], carry[key])
        out.append(carry.select(*BELIEF))
    close(rollout, torch.stack(out, 1), BELIEF)


@pytest.mark.parametrize("actions", [False, True])
def test_a_window_of_a_policys_data_is_its_steps(float64, actions):
    """Resumed in the middle of an episode, with resets inside and marks as SliceSampler puts them."""
    features = ["resets", "mask on one"] + ["actions"] * actions
    frames, filter = frames_for(features), deterministic(features)
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


def deterministic(features):
    filter = compose(features)
    filter["analysis"].scheme = "sakov"
    return filter


# ---------------------------------------------------------------------------------- in distribution, under fresh noise


@pytest.mark.parametrize("way", ["step", "sequence"])
def test_two_sensors_draw_their_own_noise(way):
    torch.manual_seed(0)
    one, h = torch.eye(2), {}
    for name in ("first", "second"):
        h[name] = VectorSensor(
            2, 2, ensemble_size=500, num_cells=(16,), rate=0.5, in_key="y", out_key=(name, "ensemble")
        )
        h[name + "_noise"] = ConstantNoise([1.0, 1.0], in_key=(name, "ensemble"), out_key=(name, "noise"))
    h["second"].load_state_dict(h["first"].state_dict())
    filter = Filter(
        {
            **h,
            "transition": NoisyLinear(one),
            "observation": LinearObservation(one),
            "analysis": EnsembleAnalysis(
                "sensor", observation_key=("first", "ensemble"), noise_variance_key=("first", "noise")
            ),
        },
        initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=500),
    )
    frames = TensorDict({"y": torch.ones(3, 6, 2)}, [3, 6])
    out = filter.sequence(frames) if way == "sequence" else filter.step(filter.initialise(frames[:, 0].copy()))
    samples = [out[name, "ensemble"].reshape(-1, 2)[:, 0] for name in ("first", "second")]
    # Five standard errors of a correlation of 1,500 independent pairs.
    assert torch.corrcoef(torch.stack(samples))[0, 1].abs() < 5 / 1500**0.5


@pytest.mark.parametrize("scheme", ["perturbed", "etkf"])
@pytest.mark.parametrize("way", ["step", "sequence"])
def test_two_analyses_are_the_kalman_filter_of_both_readings(float64, scheme, way):
    """One reading after the other, each with a mask of its own, and resets."""
    F, Q, *_ = linear_system()
    kalman = linear_kalman()
    first = parts_of_reading(0, "forecast", "mid", scheme, observed_key="seen0")
    second = parts_of_reading(1, "mid", "belief", scheme, observed_key="seen1")
    filter = Filter(
        {"transition": NoisyLinear(F, torch.linalg.cholesky(Q)), **first, **second},
        initial=GaussianPrior(kalman.initial.mean, kalman.initial.cov.diagonal().sqrt(), ensemble_size=20_000),
    )
    y, seen = torch.randn(2, 8, 2), torch.rand(2, 8, 2) < 0.7
    start = torch.zeros(2, 8, 1, dtype=torch.bool)
    start[:, 0] = start[1, 4] = True
    exact = kalman.sequence(TensorDict({"observation": y, "observed": seen, "is_init": start}, [2, 8]))
    frames = TensorDict({"y0": y[..., :1], "y1": y[..., 1:], "is_init": start}, [2, 8])
    frames.update({"seen0": seen[..., :1], "seen1": seen[..., 1:]})
    out = stepwise(filter, frames) if way == "step" else filter.sequence(frames)
    # Five standard errors of 20,000 members, of the mean and of the variance.
    torch.testing.assert_close(out["belief", "mean"], exact["belief", "mean"], rtol=0, atol=0.06)
    torch.testing.assert_close(out["belief", "var"], exact["belief", "var"], rtol=0.07, atol=0.01)
    likelihood = sum(out[key] for key in filter.structure.likelihoods)
    torch.testing.assert_close(likelihood, exact["info", "log_likelihood"], rtol=0, atol=0.1)
    own = [out["info", name, "log_likelihood"] for name in ("a0", "a1")]
    torch.testing.assert_close(own[0] + own[1], out["info", "log_likelihood"])
