"""The ten points of the check-list for a drop-in part.

``kind`` names how the transform is combined with an environment: on a batch-locked environment of batch size [] or
[3], inside or outside of a ``SerialEnv`` or ``ParallelEnv`` of two.
"""

from functools import partial

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SliceSampler
from torchrl.envs import Compose, InitTracker, ParallelEnv, SerialEnv, TransformedEnv

from tests.filters.factories import assert_equal
from tests.transforms.envs_for_tests import (
    BELIEF,
    PRIOR_MEAN,
    STEPS,
    filtered_env,
    fixed_filter,
    forked_env,
    half_known_filter,
    random_rollout,
    seeded_env,
    toy_base_env,
    toy_filter,
)
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.transforms import DEnKFTransform


def make_env(kind, make_filter=half_known_filter):
    if kind == "[]":
        return filtered_env(make_filter, max_steps=STEPS[0])
    if kind == "[3]":
        return filtered_env(make_filter, batch_size=[3], max_steps=[*STEPS, 30])
    if "inside" in kind:  # spawned workers draw noise of their own from the beginning, which forked ones do not
        batched = SerialEnv if "serial" in kind else ParallelEnv
        return batched(2, [partial(filtered_env, make_filter, max_steps=n, seed=n) for n in STEPS])
    batched = SerialEnv if "serial" in kind else forked_env
    plain = batched(2, [partial(seeded_env, n, max_steps=n) for n in STEPS])
    return TransformedEnv(plain, DEnKFTransform(make_filter()))


KINDS = ["[]", "[3]", "serial inside", "serial outside", "parallel inside", "parallel outside"]


@pytest.fixture(scope="module", params=KINDS)
def env(request):
    env = make_env(request.param)
    env.first = env.reset()["belief", "ensemble"]  # before anything was seeded
    yield env
    env.close()


def test_partial_resets(env):
    rollout = random_rollout(env)
    if not env.batch_size:
        rollout = rollout.unsqueeze(0)
    ensemble, next_ensemble = rollout["belief", "ensemble"], rollout["next", "belief", "ensemble"]
    done = rollout["next", "done"].squeeze(-1)
    # 12 steps of episodes of 3 and 5: resets after steps 3, 6, 9 (12) and 5, 10.
    for row, length in enumerate(STEPS[: len(rollout)]):
        assert (done[row].nonzero().flatten() + 1).tolist() == list(range(length, 13, length))
    known, drawn = PRIOR_MEAN  # the prior's first component has no spread, its second that of one standard deviation
    after = done[:, :-1]
    for start in (ensemble[:, 0], ensemble[:, 1:][after]):
        assert (start[..., 0] == known).all(), "rows that reset get the prior"
        assert ((start[..., 1] - drawn).abs() < 5).all()
        assert start[..., 1].unique().numel() == start[..., 1].numel(), "drawn again each time"
    assert ensemble[:, 1:][~after].equal(next_ensemble[:, :-1][~after]), "other rows keep their belief"
    # It is not the prior that they keep: two steps on, every member has moved.
    assert (next_ensemble[..., 0] != known).all()
    assert_equal(
        rollout["next", "belief"].exclude("ensemble"),
        {"mean": next_ensemble.mean(-2), "var": next_ensemble.var(-2)},
        ["mean", "var"],
        atol=1e-6,
    )


@pytest.mark.parametrize("update_at_reset", [False, True])
@pytest.mark.parametrize("kind", ["[]", "[3]", "serial outside"])
def test_steps_equal_the_sequence(kind, update_at_reset):
    env = make_env(kind, partial(fixed_filter, update_at_reset=update_at_reset))
    env = TransformedEnv(env, InitTracker())
    rollout = random_rollout(env)
    assert rollout["is_init"].sum() > rollout.shape[:-1].numel(), "resets in mid-sequence"
    frames = rollout.select("observation", "observed", "is_init", "action")
    transform = next(part for part in env.transform if isinstance(part, DEnKFTransform))
    # As a replay buffer would: from the initial belief, and from the belief that is stored.
    # float32 arithmetic in another order; the filter contracts the differences.
    assert_equal(transform(frames), rollout, BELIEF, atol=1e-5)
    assert_equal(transform(rollout[..., 2:].copy()), rollout[..., 2:], BELIEF, atol=1e-5)
    assert frames["forecast", "ensemble"].shape == frames["belief", "ensemble"].shape


def test_collector_replay_buffer_loss_gradients():
    filter = toy_filter()
    env = TransformedEnv(
        toy_base_env(batch_size=[3], max_steps=[7, 9, 50], missing=0.2), Compose(InitTracker(), DEnKFTransform(filter))
    )
    policy = TensorDictModule(nn.Linear(3, 2), in_keys=[("belief", "mean")], out_keys=["action"])
    collector = Collector(env, policy, frames_per_batch=90, total_frames=180)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(300),
        sampler=SliceSampler(slice_len=6, traj_key=("collector", "traj_ids"), strict_length=True),
        batch_size=48,
    )
    for data in collector:
        assert data["belief", "mean"].isfinite().all()
        buffer.extend(data.reshape(-1))
    collector.shutdown()
    batch = buffer.sample()
    batch["is_init"] = batch["is_init"].clone()
    batch["is_init"].view(8, 6, 1)[:, 0] = True
    loss = DEnKFLoss(filter)
    loss.set_keys(target_observation="truth")
    batch["truth"] = batch["state"][..., :2]
    losses = loss(batch)
    sum(losses.values()).backward()
    for name in ("transition", "sensor", "observation", "noise"):
        grads = [parameter.grad for parameter in filter[name].parameters() if parameter.grad is not None]
        assert grads, name
        assert all(grad.isfinite().all() for grad in grads), name
        assert any((grad != 0).any() for grad in grads), name


@pytest.mark.parametrize("env", KINDS[1:], indirect=True, scope="module")
def test_rows_and_workers_differ(env):
    torch.manual_seed(1)  # of the filter, where it runs in this process
    env.set_seed(1)
    seeded = env.reset()["belief", "ensemble"]
    for start in (env.first, seeded):
        assert not start[0].equal(start[1]), "also where nothing was seeded"
    assert not seeded.equal(env.first)
    rollout = random_rollout(env, 4)
    noise = rollout["next", "belief", "ensemble"] - rollout["next", "belief", "mean"].unsqueeze(-2)
    assert not noise[0].allclose(noise[1])
