"""Simulators that reset by themselves, as Isaac Lab and mjlab do: torchrl writes NaN into the next part of done rows.

The oracle is the same filter on the stored frames, with the marks of where episodes begin.
"""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import ExcludeTransform, InitTracker, TransformedEnv

from tests.filters.factories import assert_equal, linear_kalman, linear_system, toy_denkf
from tests.transforms.envs_for_tests import A, M, S
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.imperfect import RejectReadings
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.transforms import DEnKFTransform

STEPS = [3, 5, 30]  # episode lengths of the three rows


class ResetsByItself(LinearGaussianEnv):
    """Rows that are done begin their next episode within the step, as in a simulator on a GPU."""

    def __init__(self, *args, native=True, **kwargs):
        super().__init__(*args, **kwargs)
        self._torchrl_native_autoreset = native

    def _step(self, tensordict):
        out, fresh = super()._step(tensordict), self._reset()
        done = out["done"]
        for key in ("state", "observation", "observed", "step"):
            out[key] = torch.where(done, fresh[key], out[key])
        return out


def simulator(**kwargs):
    F, Q, H, R = linear_system()
    return ResetsByItself(F, H, Q.diagonal().sqrt(), R.sqrt(), batch_size=[3], max_steps=STEPS, **kwargs)


def collected(env, policy=None, frames=3 * 12):
    collector = Collector(env, policy, frames_per_batch=frames, total_frames=frames)
    data = next(iter(collector))
    collector.shutdown()
    return data


def next_is_nan_where_done(data):
    done = data["next", "done"].expand_as(data["next", "observation"])
    return data["next", "observation"].isnan().equal(done) and int(data["next", "done"].sum()) == 6


def test_belief_is_reset_with_the_simulators_autoreset(float64):
    filter = linear_kalman()
    env = TransformedEnv(simulator(), InitTracker())
    env.append_transform(DEnKFTransform(filter))
    data = collected(env)
    assert next_is_nan_where_done(data)
    expected = filter.sequence(data.select("observation", "observed", "is_init"))
    assert_equal(data, expected, filter.belief_keys)
    going_on = ~data["next", "done"][:, :-1].squeeze(-1)
    for key in filter.belief_keys:
        assert data["next", key][:, :-1][going_on].equal(data[key][:, 1:][going_on])


@pytest.mark.parametrize("rejected", [False, True])
def test_nan_before_the_filter_raises_without_a_mask_and_is_a_missing_reading_with_one(float64, rejected):
    env = simulator(native=False, auto_reset=True)  # torchrl's own transform writes NaN first
    env.append_transform(InitTracker())
    env.append_transform(ExcludeTransform("observed"))
    filter = linear_kalman()
    if not rejected:
        env.append_transform(DEnKFTransform(filter))
        with pytest.raises(ValueError, match=r"NaN or infinity in \['observation'\].*RejectReadings"):
            env.rollout(12, break_when_any_done=False)
        return
    env.append_transform(RejectReadings({"observation": "observed"}))
    env.append_transform(DEnKFTransform(filter))
    data = env.rollout(12, break_when_any_done=False)
    assert data["next", "observed"].equal(~data["next", "done"])
    assert_equal(data, filter.sequence(data.select("observation", "observed", "is_init")), filter.belief_keys)


def test_in_a_buffer_and_a_loss_gradients_are_those_of_data_without_nan(float64):
    generator = torch.Generator().manual_seed(0)
    matrices = 0.3 * torch.randn(S, S, generator=generator), torch.randn(M, S, generator=generator)
    base = ResetsByItself(*matrices, [0.3] * S, [0.1] * M, control=torch.zeros(S, A), batch_size=[3], max_steps=STEPS)
    data = collected(TransformedEnv(base, InitTracker())).rename_key_("observation", "measurement")
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(36), sampler=SliceSampler(slice_len=4, end_key=("next", "done")), batch_size=80
    )
    ended = data.clone()
    ended["next", "done"][:, -1] = True  # of the last, cut, episode
    buffer.extend(ended.reshape(-1))
    torch.manual_seed(0)
    batch = buffer.sample()
    assert batch["next", "observation"].isnan().any()
    denkf = toy_denkf().double()
    found = []
    for cleaned in (False, True):
        one = batch.clone()
        if cleaned:
            one["next"] = one["next"].apply(lambda value: value.nan_to_num(7.0) if value.is_floating_point() else value)
        torch.manual_seed(1)
        loss = sum(DEnKFLoss(denkf, sensor=0.0)(one).values())
        found.append(torch.autograd.grad(loss, list(denkf.parameters())))
    for ours, theirs in zip(*found, strict=True):
        assert ours.isfinite().all()
        assert ours.equal(theirs)
