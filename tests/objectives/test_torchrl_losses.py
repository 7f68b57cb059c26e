"""torchrl's losses on a policy with a filter inside: the oracle is the loss written out, step by step."""

from functools import partial

import pytest
import torch
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictSequential
from torch import nn
from torch.distributions import Independent, Normal
from torchrl.envs import TransformedEnv
from torchrl.modules import ProbabilisticActor, TanhNormal, ValueOperator, set_recurrent_mode
from torchrl.modules.utils import get_env_transforms_from_module
from torchrl.objectives import ClipPPOLoss, DDPGLoss, SACLoss

from tests.filters.composed import A, B, ReplayedFrames, S, T, compose, frames_for

MEAN = ("belief", "mean")


def filter_and_frames(actions=True):
    features = ["resets", "mask on one", "two sensors"] + ["actions"] * actions
    filter = compose(features)
    for name in ("analysis", "analysis_b"):
        filter[name].scheme = "sakov"  # without noise of its own, so that both computations are the same numbers
    return filter, frames_for(features)


class SummedNormal(Independent):
    """Independent actions."""

    def __init__(self, loc, scale):
        super().__init__(Normal(loc, scale), 1)


class Player(nn.Module):
    """The recorded actions, so that data do not depend on the networks."""

    def __init__(self, frames):
        super().__init__()
        self.actions = frames["action"]

    def forward(self, index):
        return self.actions[:, index.flatten()[0]]


def collected(filter, frames):
    """Data as a collector's: the filter is in the policy, its belief is carried by the primer."""
    env = ReplayedFrames(frames)
    policy = TensorDictSequential(filter, TensorDictModule(Player(frames), ["index"], ["action"]))
    env = TransformedEnv(env, get_env_transforms_from_module(policy))
    torch.manual_seed(0)
    with torch.no_grad():
        data = env.rollout(T, policy, break_when_any_done=False)
    data["next", "reward"] = torch.randn_like(data["next", "reward"])
    data["next", "terminated"] = data["next", "done"].clone()
    return data[:, 2:]  # windows that begin in the middle of an episode


def beliefs_by_hand(filter, data):
    """Returns the belief's mean at every root and every next observation, one step after the other."""
    roots, nexts, carry = [], [], None
    for t in range(data.shape[1]):
        row = data[:, t]
        resumed = {key: row["previous", *key] for key in filter.carry_keys}
        if t == 0:
            carry = {key: value.clone() for key, value in resumed.items()}
        now = filter.step(one_step(filter, row, row["previous", "action"], carry))
        start = filter.initialise(one_step(filter, row, row["previous", "action"], carry))
        is_new = row["is_init"] & ~row["previous", "known"]
        pick = lambda key: torch.where(is_new.reshape(B, *[1] * (now[key].ndim - 1)), start[key], now[key])  # noqa: E731, B023
        carry, mean = {key: pick(key) for key in filter.carry_keys}, pick(MEAN)
        roots.append(mean)
        nexts.append(filter.step(one_step(filter, row["next"], row["action"], carry))[MEAN])
    return torch.stack(roots, 1), torch.stack(nexts, 1)


def one_step(filter, row, action, carry):
    out = row.select("a", "b", "seen").copy().set("action", action)
    for key, value in carry.items():
        out[key] = value
    return out


def gradients(loss, modules):
    parameters = [p for module in modules for p in module.parameters()]
    found = torch.autograd.grad(loss, parameters, retain_graph=True, allow_unused=True)
    return [torch.zeros_like(p) if g is None else g for p, g in zip(parameters, found, strict=True)]


def assert_same_gradients(ours, by_hand, modules):
    first, second = gradients(ours, modules), gradients(by_hand, modules)
    assert any((gradient != 0).any() for gradient in second)
    for gradient, expected in zip(first, second, strict=True):
        torch.testing.assert_close(gradient, expected, rtol=1e-9, atol=1e-12)


def q_network():
    class Q(nn.Module):
        def __init__(self):
            super().__init__()
            self.layers = nn.Sequential(nn.Linear(S + A, 8), nn.Tanh(), nn.Linear(8, 1))

        def forward(self, mean, action):
            return self.layers(torch.cat([mean, action], -1))

    return ValueOperator(Q(), in_keys=[MEAN, "action"])


@pytest.mark.parametrize("slices", [False, True])
def test_ddpg(float64, slices):
    filter, frames = filter_and_frames()
    data = collected(filter, frames)
    head = nn.Linear(S, A)
    actor = TensorDictSequential(filter, TensorDictModule(head, [MEAN], ["action"]))
    value = q_network()
    loss = DDPGLoss(actor, value, delay_actor=False, delay_value=False, loss_function="l2")
    loss.make_value_estimator(gamma=0.9)
    sample = data.copy()
    if slices:  # flat, with the marks that SliceSampler puts
        sample["is_init"][:, 0] = True
        sample["next", "done"][:, -1] = True
        sample = sample.reshape(-1)
    out = loss(sample)

    roots, nexts = beliefs_by_hand(filter, data)
    by_hand = -value.module(roots, head(roots)).mean()
    torch.testing.assert_close(out["loss_actor"], by_hand)
    assert_same_gradients(out["loss_actor"], by_hand, [filter, head])

    target = data["next", "reward"] + 0.9 * ~data["next", "terminated"] * value.module(nexts, head(nexts))
    predicted = value.module(data[MEAN], data["action"])  # of the stored belief: the critic reads no frames
    by_hand = nn.functional.mse_loss(predicted, target.detach())
    torch.testing.assert_close(out["loss_value"], by_hand)


def test_clipped_ppo(float64):
    filter, frames = filter_and_frames()
    data = collected(filter, frames)
    head, critic_head = nn.Sequential(nn.Linear(S, 2 * A), NormalParamExtractor()), nn.Linear(S, 1)
    critic = ValueOperator(critic_head, in_keys=[MEAN])
    data["advantage"], data["value_target"] = torch.randn(B, T - 2, 1), torch.randn(B, T - 2, 1)
    data["state_value"] = torch.randn(B, T - 2, 1)

    roots, _ = beliefs_by_hand(filter, data)
    loc, scale = head(roots)
    log_prob = Normal(loc, scale).log_prob(data["action"])
    stored = log_prob.sum(-1).detach() + 0.3 * torch.randn(B, T - 2)
    data["action_log_prob"] = stored
    actor = ProbabilisticActor(
        TensorDictSequential(filter, TensorDictModule(head, [MEAN], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=SummedNormal,
        return_log_prob=True,
    )
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=0.2,
        entropy_bonus=False,
        normalize_advantage=False,
        critic_coeff=0.5,
        loss_critic_type="l2",
    )
    loss.set_keys(sample_log_prob="action_log_prob")
    out = loss(data.copy())
    ratio = (log_prob.sum(-1) - stored).exp().unsqueeze(-1)
    advantage = data["advantage"]
    by_hand = -torch.minimum(ratio * advantage, ratio.clamp(0.8, 1.2) * advantage).mean()
    torch.testing.assert_close(out["loss_objective"], by_hand)
    assert_same_gradients(out["loss_objective"], by_hand, [filter, head])
    by_hand = 0.5 * (critic_head(roots) - data["value_target"]).square().mean()  # the actor has filtered for the critic
    torch.testing.assert_close(out["loss_critic"], by_hand)
    assert_same_gradients(out["loss_critic"], by_hand, [filter, critic_head])


def q_of(loss, mean, action, number=0):
    params = loss.qvalue_network_params[number].detach()
    with params.to_module(loss.qvalue_network):
        return loss.qvalue_network.module(mean, action)


def soft_value(head, mean, q):
    """Returns the worth of an action that is drawn, by the less of two critics, with the reward of its entropy."""
    chosen = TanhNormal(*head(mean))
    action = chosen.rsample()
    worth = torch.stack([q(mean, action, number) for number in (0, 1)]).min(0).values
    return worth - 0.3 * chosen.log_prob(action).unsqueeze(-1)


def critics_by_hand(data, roots, nexts, head, q):
    """Returns the squared error of both critics at the beliefs ``roots``."""
    target = data["next", "reward"] + 0.9 * ~data["next", "terminated"] * soft_value(head, nexts, q)
    return sum((q(roots, data["action"], number) - target.detach()).square().mean() for number in (0, 1))


def filtered(filter, batch):
    """Replaces the beliefs stored at collection by those of the present filter, as on the page."""
    with set_recurrent_mode(True):
        filter(batch)
        for key in filter.carry_keys:
            batch["next", "previous", *key] = batch[key].detach()
        with torch.no_grad():
            filter(batch["next"])
    return batch


def with_other_beliefs(data):
    """Changes the beliefs stored at collection."""
    out = data.clone()
    out["belief"].apply_(lambda value: value.fill_(50.0))
    return out


def sac(filter, *, inside, **options):
    """SAC on a filter's belief; with the filter in the actor, or in front of it."""
    head = nn.Sequential(nn.Linear(S, 2 * A), NormalParamExtractor())
    own = TensorDictModule(head, [MEAN], ["loc", "scale"])
    actor = ProbabilisticActor(
        TensorDictSequential(filter, own) if inside else own,
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    options = {"fixed_alpha": True, "alpha_init": 0.3, "target_entropy": -2.0, "loss_function": "l2", **options}
    return actor, head, options


def test_sac_on_recomputed_beliefs(float64):
    """Both losses written out, with the beliefs of each step by hand; what was stored must not matter."""
    filter, frames = filter_and_frames()
    data = collected(filter, frames)
    actor, head, options = sac(filter, inside=False)
    loss = SACLoss(actor, q_network(), **options)
    loss.make_value_estimator(gamma=0.9)
    with torch.no_grad():  # it has learned since
        for parameter in filter.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    found = []
    for stored in (data, with_other_beliefs(data)):
        torch.manual_seed(3)
        found.append(loss(filtered(filter, stored.clone())))
    assert found[0]["loss_qvalue"].equal(found[1]["loss_qvalue"])
    assert found[0]["loss_actor"].equal(found[1]["loss_actor"])

    roots, nexts = beliefs_by_hand(filter, data)
    assert not torch.allclose(roots, data[MEAN], atol=1e-3), "the stored beliefs are old"
    torch.manual_seed(3)
    q = partial(q_of, loss)
    by_hand = critics_by_hand(data, roots, nexts, head, q)
    torch.testing.assert_close(found[0]["loss_qvalue"], by_hand)
    assert_same_gradients(found[0]["loss_qvalue"], by_hand, [filter])

    by_hand = -soft_value(head, roots, q).mean()
    torch.testing.assert_close(found[0]["loss_actor"], by_hand)
    assert_same_gradients(found[0]["loss_actor"], by_hand, [filter, head])


@pytest.mark.parametrize("vmap", [True, False])
def test_sac_with_the_filter_in_the_critic_too(float64, vmap):
    """``separate_losses`` alone leaves the filter its weights; otherwise torchrl draws a critic's weights again."""
    filter, frames = filter_and_frames()
    data = collected(filter, frames)
    actor, head, options = sac(filter, inside=True)
    critic = TensorDictSequential(filter, q_network())
    loss = SACLoss(actor, critic, separate_losses=True, deactivate_vmap=not vmap, **options)
    loss.make_value_estimator(gamma=0.9)
    loss.set_vmap_randomness("different")
    found = []
    for stored in (data, with_other_beliefs(data)):
        torch.manual_seed(3)
        found.append(loss.qvalue_v2_loss(stored.clone())[0])
    assert found[0].equal(found[1])
    roots, nexts = beliefs_by_hand(filter, data)
    torch.manual_seed(3)
    of_critic = [params.detach()["module", "1"] for params in loss.qvalue_network_params.unbind(0)]

    def q_by_hand(mean, action, number):
        with of_critic[number].to_module(critic[1]):
            return critic[1].module(mean, action)

    torch.testing.assert_close(found[0].mean(), critics_by_hand(data, roots, nexts, head, q_by_hand))
