"""The programs of the page on policies: which gradients reach the filter, and what is filtered anew."""

import re
from functools import cache

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.envs import ExplorationType
from torchrl.modules import TanhNormal, set_recurrent_mode
from torchrl.objectives import DDPGLoss, SACLoss, SoftUpdate

from tests.filters.composed import A, S
from tests.objectives.test_torchrl_losses import (
    MEAN,
    beliefs_by_hand,
    collected,
    filter_and_frames,
    filtered,
    q_network,
    sac,
    with_other_beliefs,
)
from tests.test_docs import BLOCK, ROOT

PAGE = ROOT / "docs/how_to/policies.md"
PROGRAMS = ("ppo", "sac", "ddpg")


def code(name):
    setup, *blocks = (match["code"] for match in BLOCK.finditer(PAGE.read_text()))
    parts = dict(zip(PROGRAMS, blocks, strict=False))  # what comes behind them is of simulators
    before, _, after = parts["sac"].partition("head = ")
    parts["ddpg"] = before + parts["ddpg"] + after[after.index("loss.make_value_estimator") :]
    return setup + parts[name]


@cache
def run(name):
    """The program's names after it ran, with the small setting of the page."""
    names = {}
    exec(compile(code(name), f"{name} of the page", "exec"), names)
    return names


def reaches(loss, filter):
    if not loss.requires_grad:
        return False
    found = torch.autograd.grad(loss, list(filter.parameters()), retain_graph=True, allow_unused=True)
    return any(gradient is not None and bool(gradient.any()) for gradient in found)


def slices(names):
    return names["slices"][:4] if "slices" in names else names["buffer"].sample().reshape(-1, 25)[:4]


def test_both_of_ppos_losses_reach_the_filter():
    names = run("ppo")
    terms = names["loss"](slices(names))
    assert reaches(terms["loss_objective"], names["denkf"])
    assert reaches(terms["loss_critic"], names["denkf"])
    own = {id(parameter) for parameter in names["loss"].parameters()}
    assert {id(parameter) for parameter in names["denkf"].parameters()} <= own


@pytest.mark.parametrize("detached", [True, False])
def test_sacs_losses_reach_the_filter_only_where_nothing_is_detached(detached):
    names = run("sac")
    batch = names["filtered"](slices(names))
    terms = names["loss"](batch.detach() if detached else batch)
    for name in ("loss_actor", "loss_qvalue"):
        assert reaches(terms[name], names["denkf"]) != detached
    assert reaches(batch["info", "log_likelihood"].mean(), names["denkf"])


def test_ddpgs_losses_reach_no_filter_in_front_and_the_actors_one_inside():
    names = run("ddpg")
    batch = names["filtered"](slices(names))
    terms = names["loss"](batch)
    assert not reaches(terms["loss_actor"], names["denkf"])
    assert not reaches(terms["loss_value"], names["denkf"])
    inside = DDPGLoss(names["policy"], names["critic"])
    inside.make_value_estimator(gamma=0.95)
    terms = inside(batch)
    assert reaches(terms["loss_actor"], names["denkf"])
    assert not reaches(terms["loss_value"], names["denkf"])


@pytest.mark.parametrize("name", ["sac", "ddpg"])
def test_what_was_believed_after_the_start_of_a_slice_does_not_matter(name):
    names = run(name)
    losses = []
    batch = slices(names)
    for stored in (batch, with_other_beliefs(batch)):
        torch.manual_seed(3)
        losses.append(names["loss"](names["filtered"](stored.clone())))
    for key in set(losses[0].keys()) & {"loss_actor", "loss_qvalue", "loss_value"}:
        assert losses[0][key].equal(losses[1][key])
        assert losses[0][key] != 0


class Regulator(nn.Module):
    """The linear-quadratic regulator of the page's mass, held at what the motor can do."""

    def __init__(self):
        super().__init__()
        moves, motor, cost = torch.tensor([[1.0, 0.1], [-0.1, 0.98]]), torch.tensor([[0.0], [0.2]]), torch.zeros(2, 2)
        cost[0, 0] = 1.0
        worth = cost
        for _ in range(500):  # Riccati's recursion
            self.gain = torch.linalg.solve(0.1 + motor.mT @ worth @ motor, motor.mT @ worth @ moves)
            worth = cost + moves.mT @ worth @ (moves - motor @ self.gain)

    def forward(self, state):
        return (-state @ self.gain.mT).clamp(-1, 1)


class Still(nn.Module):
    """No push."""

    def forward(self, state):
        return torch.zeros_like(state[..., :1])


def with_policy(names, policy, call):
    names["policy"], before = policy, names["policy"]
    try:
        return call()
    finally:
        names["policy"] = before


def regulated(names):
    """The page's return of a regulator on the belief of a filter that knows the motor."""
    weight = names["motion"].weight
    before = weight.detach().clone()
    policy = TensorDictSequential(names["denkf"], TensorDictModule(Regulator(), [MEAN], ["action"]))
    try:
        weight.data.copy_(torch.tensor([[1.0, 0.1, 0.0], [-0.1, 0.98, 0.2]]))
        return with_policy(names, policy, names["test"])
    finally:
        weight.data.copy_(before)


def test_the_returns_that_need_no_training_are_those_of_the_page():
    names = run("ppo")
    torch.manual_seed(0)
    still = with_policy(names, TensorDictModule(Still(), ["state"], ["action"]), names["test"])
    truth = with_policy(names, TensorDictModule(Regulator(), ["state"], ["action"]), names["test"])
    row = re.search(r"^\| regulator .*$", PAGE.read_text(), re.MULTILINE)[0]
    stated = [float(number) for number in re.findall(r"-\d+\.\d", row)]
    assert [regulated(names), truth] == pytest.approx(stated, abs=0.2)
    stated = float(re.search(r"without any push returns (-\d+\.\d)", PAGE.read_text())[1])
    assert still == pytest.approx(stated, abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "rounds"), [("ppo", 25), ("sac", 20), ("ddpg", 20)])
def test_a_program_learns(name, rounds):
    """The loss against a regulator that knows everything but the state is a quarter of that of no push, at most."""
    names = {}
    exec(code(name).replace("ROUNDS, SEED = 2,", f"ROUNDS, SEED = {rounds},"), names)
    assert names["ROUNDS"] == rounds
    best = regulated(names)
    still = with_policy(names, TensorDictModule(Still(), ["state"], ["action"]), names["test"])
    assert names["test"]() > best + 0.25 * (still - best)


class Draw(TensorDictModuleBase):
    """Draws a filter's noise, so that what is collected holds it."""

    def __init__(self, filter):
        super().__init__()
        self.in_keys, self.out_keys = [], [("noise", "transition"), ("noise", "initial")]
        self.__dict__["filter"] = filter

    def forward(self, tensordict):
        return self.filter.draw_noise(tensordict)


@pytest.mark.parametrize("length", [50, 25, 10])
def test_a_slice_gives_the_beliefs_that_the_collector_had(length):
    """With the collector's noise: episodes cut into slices, each from the belief that is stored before it."""
    names = run("ppo")
    policy = TensorDictSequential(Draw(names["denkf"]), names["policy"])
    play = names["play"]
    data = with_policy(names, policy, lambda: play(3, 5, ExplorationType.RANDOM))
    assert ("noise", "transition") in data.keys(True)
    rows = data.reshape(-1, length)
    with torch.no_grad(), set_recurrent_mode(True):
        again = names["denkf"](with_other_beliefs(rows))
    torch.testing.assert_close(again[MEAN], rows[MEAN], rtol=1e-4, atol=1e-5)


def test_ddpg_in_front_with_target_networks(float64):
    """Both losses written out; the target is of the slowly following networks, on what the filter believes now."""
    filter, frames = filter_and_frames()
    data = collected(filter, frames)
    head, value = nn.Linear(S, A), q_network()
    actor = TensorDictModule(head, [MEAN], ["action"])
    loss = DDPGLoss(actor, value, delay_actor=True)
    loss.make_value_estimator(gamma=0.9)
    updater = SoftUpdate(loss, tau=0.25)  # puts the networks themselves in the place of the target networks
    before = [[p.clone() for p in network.parameters()] for network in (head, value)]
    with torch.no_grad():
        for parameter in [*filter.parameters(), *loss.parameters()]:
            parameter.add_(0.1 * torch.randn_like(parameter))
    updater.step()
    out = loss(filtered(filter, with_other_beliefs(data)))

    roots, nexts = beliefs_by_hand(filter, data)
    torch.testing.assert_close(out["loss_actor"], -value.module(roots, head(roots)).mean())
    predicted = value.module(roots, data["action"]).detach()
    with torch.no_grad():
        for network, old in zip((head, value), before, strict=True):
            for parameter, earlier in zip(network.parameters(), old, strict=True):
                parameter.copy_(0.25 * parameter + 0.75 * earlier)
        worth = value.module(nexts, head(nexts))
    target = data["next", "reward"] + 0.9 * ~data["next", "terminated"] * worth
    torch.testing.assert_close(out["loss_value"], nn.functional.mse_loss(predicted, target))


@pytest.mark.parametrize("vmap", [True, False])
def test_sac_in_front_with_target_networks(float64, vmap):
    """Two critics, whose target networks have followed a quarter of the way: the critics' loss written out."""
    filter, frames = filter_and_frames()
    data = collected(filter, frames)
    actor, head, options = sac(filter, inside=False)
    loss = SACLoss(actor, q_network(), deactivate_vmap=not vmap, **options)
    loss.make_value_estimator(gamma=0.9)
    updater = SoftUpdate(loss, tau=0.25)
    with torch.no_grad():
        for parameter in loss.qvalue_network_params.values(True, True):
            parameter.add_(0.1 * torch.randn_like(parameter))
    old = loss.target_qvalue_network_params.clone()
    updater.step()
    torch.manual_seed(3)
    found = loss(filtered(filter, with_other_beliefs(data)))["loss_qvalue"]

    def q_by_hand(params, mean, action):
        with params.to_module(loss.qvalue_network):
            return loss.qvalue_network.module(mean, action)

    roots, nexts = beliefs_by_hand(filter, data)
    torch.manual_seed(3)
    ahead = TanhNormal(*head(nexts.detach()))
    action = ahead.rsample()
    now = loss.qvalue_network_params.detach()
    slow = (0.25 * now.to_tensordict() + 0.75 * old.to_tensordict()).detach()
    worth = torch.stack([q_by_hand(slow[number], nexts, action) for number in (0, 1)]).min(0).values
    worth = worth - 0.3 * ahead.log_prob(action).unsqueeze(-1)
    target = (data["next", "reward"] + 0.9 * ~data["next", "terminated"] * worth).detach()
    by_hand = sum((q_by_hand(now[number], roots, data["action"]) - target).square().mean() for number in (0, 1))
    torch.testing.assert_close(found, by_hand)
