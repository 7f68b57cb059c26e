"""The programs of the page on policies: which gradients reach the filter, and what is filtered anew."""

from functools import cache

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torchrl.objectives import DDPGLoss

from tests.objectives.test_torchrl_losses import (
    MEAN,
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
