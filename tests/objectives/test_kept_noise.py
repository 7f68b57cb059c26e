"""A policy's data are filtered with the draws that they were collected with. Oracle: the probabilities stored there."""

from functools import partial

import pytest
import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import RenameTransform, TransformedEnv
from torchrl.modules import (
    IndependentNormal,
    NormalParamExtractor,
    ProbabilisticActor,
    ValueOperator,
    set_recurrent_mode,
)
from torchrl.modules.utils import get_env_transforms_from_module
from torchrl.objectives import A2CLoss, ClipPPOLoss

from tests.filters.differences_for_tests import central_difference
from tests.filters.factories import OBS, A, M, S, toy_denkf
from tests.filters.particle_for_tests import toy_filter as toy_particles
from tests.transforms.envs_for_tests import forked_env, toy_base_env
from torch_denkf.filters import EKF
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import (
    DiagonalNoise,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    MomentPrior,
    StochasticMLP,
    VectorSensor,
)


def stochastic_parts(rate=0.3):
    motion = StochasticMLP(S + A, S, (8,), rate=rate, output_gain=0.5)
    return LearnedTransition(motion, action_key="action"), LearnedObservation(StochasticMLP(S, OBS, (8,), layer="none"))


def toy_ekf(**options):
    transition, observation = stochastic_parts()
    sensor = VectorSensor(M, OBS, ensemble_size=8, num_cells=(8, 8), rate=0.5, in_key="measurement")
    start, noise = MomentPrior(torch.zeros(S), torch.eye(S)), DiagonalNoise(OBS, r=0.5, num_cells=(4,))
    return EKF(transition, sensor, observation, noise, process_noise=0.3, initial=start, **options)


def toy_fused(**options):
    transition, observation = stochastic_parts()
    read = partial(VectorSensor, M, OBS, ensemble_size=6, num_cells=(8,), rate=0.5, in_key="measurement")
    sensors = {name: FusedSensor(observation, [0.5] * OBS, read(), delay=late) for name, late in (("a", 0), ("b", 2))}
    start = GaussianPrior([0.0] * S, [1.0] * S, ensemble_size=6)
    return FusedFilter(transition, sensors, initial=start, process_noise=0.2, **options)


FILTERS = {
    "DEnKF": toy_denkf,
    "flipout": partial(toy_denkf, layer="flipout", sensor_layer="flipout"),
    "perturbed": partial(toy_denkf, "perturbed", prefix="imu", update_at_reset=True),
    "particle filter": toy_particles,
    "EKF": toy_ekf,
    "fused": toy_fused,
}
every_filter = pytest.mark.parametrize("name", FILTERS)


def make_policy(filter, *between, key=None):
    """The head reads the filter's mean, or what a module between both writes."""
    head = nn.Sequential(nn.Linear(S, 2 * A), NormalParamExtractor(scale_lb=0.05))
    actor = ProbabilisticActor(
        TensorDictModule(head, [key or filter.outer(("belief", "mean"))], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        default_interaction_type="random",
    )
    return ProbabilisticTensorDictSequential(filter, *between, *actor)


def world(*transforms, **options):
    env = TransformedEnv(toy_base_env(**options), RenameTransform(["observation"], ["measurement"]))
    for transform in transforms:
        env.append_transform(transform)
    return env


def rows_of(count=3):
    return world(batch_size=[count], max_steps=[4, 6, 20][:count])


def log_ratio(policy, data):
    """By the entries alone that the policy says it reads, as A2C selects them."""
    with torch.no_grad(), set_recurrent_mode(True):
        chosen = policy.get_dist(data.select(*policy.in_keys, strict=False))
    return chosen.log_prob(data["action"]) - data["action_log_prob"]


@torch.no_grad()
def rollout(policy, env=None, steps=12):
    env = TransformedEnv(rows_of() if env is None else env, get_env_transforms_from_module(policy))
    return env.rollout(steps, policy, break_when_any_done=False)


@every_filter
def test_the_log_ratio_before_an_update_is_zero(float64, name):
    """With resets inside; of slices that begin anywhere; and again after another epoch's pass has written beliefs."""
    policy = make_policy(FILTERS[name]())
    data = rollout(policy)
    assert data["is_init"][:, 1:].any()
    assert log_ratio(policy, data).abs().max() < 1e-9
    slices = data.reshape(-1, 4)
    assert log_ratio(policy, slices).abs().max() < 1e-9
    with torch.no_grad(), set_recurrent_mode(True):
        policy[0](slices)
    assert log_ratio(policy, slices).abs().max() < 1e-9


@every_filter
def test_without_keep_noise_new_noise_is_drawn(float64, name):
    policy = make_policy(FILTERS[name]())
    data = rollout(policy)
    again = make_policy(policy[0].with_options(keep_noise=False))
    again.load_state_dict(policy.state_dict())
    assert log_ratio(again, data).std() > 1e-3
    assert policy[0].outer("drawn") not in rollout(again).keys(True)


def test_clipping_and_a2c_see_no_change(float64):
    policy = make_policy(toy_denkf())
    data = rollout(policy).reshape(-1, 4)
    data["advantage"], data["value_target"] = torch.randn(9, 4, 1), torch.randn(9, 4, 1)
    critic = ValueOperator(nn.Linear(S, 1), in_keys=[("belief", "mean")])
    terms = ClipPPOLoss(policy, critic, entropy_bonus=False)(data)
    assert terms["clip_fraction"] == 0
    assert terms["kl_approx"].abs() < 1e-12
    loss = A2CLoss(policy, critic, entropy_bonus=False)(data)["loss_objective"]
    by_hand = -(data["action_log_prob"].unsqueeze(-1) * data["advantage"]).mean()
    torch.testing.assert_close(loss, by_hand, rtol=0, atol=1e-9)


def test_gradients_are_those_of_the_steps_that_were_taken(float64):
    """Finite differences of the probability of the whole data, noise held."""
    policy = make_policy(toy_denkf())
    data = rollout(policy)
    weight = policy[0]["transition"].module.layers[0].bias

    def total():
        with set_recurrent_mode(True):
            return policy.get_dist(data.copy()).log_prob(data["action"]).sum()

    (gradient,) = torch.autograd.grad(total(), weight)
    torch.testing.assert_close(gradient[0], central_difference(total, weight, 0), rtol=1e-5, atol=1e-6)


def test_buffers_and_workers_keep_the_noise(float64):
    policy = make_policy(toy_denkf())
    data = rollout(policy, forked_env(2, partial(world, max_steps=6)))
    assert log_ratio(policy, data).abs().max() < 1e-9
    sampler = SliceSampler(slice_len=3, end_key=("next", "done"), strict_length=True)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(24), sampler=sampler, batch_size=12)
    buffer.extend(data.reshape(-1))
    assert log_ratio(policy, buffer.sample()).abs().max() < 1e-9


def collected(kind, policy, *, envs):
    collector = kind(envs, policy, frames_per_batch=24, total_frames=48, auto_register_policy_transforms=True)
    try:
        return [batch.clone() for batch in collector]
    finally:
        collector.shutdown()


@pytest.mark.parametrize("kind", [Collector, pytest.param(MultiSyncCollector, marks=pytest.mark.slow)])
def test_collectors_keep_it(kind):
    """The second batch continues in the middle of episodes."""
    policy = make_policy(toy_denkf())
    make = partial(world, max_steps=5)
    for data in collected(kind, policy, envs=make if kind is Collector else [make, make]):
        parts = data.reshape(-1, 12)
        # Rounding of single precision: mostly 1e-6, a hundred times that where tanh saturates.
        ratio = log_ratio(policy, parts).abs()
        assert ratio.max() < 1e-3
        assert ratio.median() < 1e-5


def test_bytes_stay_bytes():
    drawn = rollout(make_policy(toy_denkf()))["drawn"]
    assert {key: value.dtype for key, value in drawn.items()} == {
        "initial": torch.float32,
        "sensor": torch.uint8,
        "transition": torch.uint8,
    }


def test_data_of_other_modules_are_filtered_with_new_draws(float64):
    """A filter without noise in its sensor reads data of one that has some."""
    policy = make_policy(toy_denkf())
    data = rollout(policy)
    quiet = policy[0].with_modules(
        sensor=VectorSensor(M, OBS, ensemble_size=4, num_cells=(8,), layer="none", in_key="measurement")
    )
    with torch.no_grad(), set_recurrent_mode(True):
        assert quiet(data.copy())["belief", "mean"].isfinite().all()
