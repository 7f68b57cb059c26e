"""The programs of the page on policies: which gradients reach the filter, and what is filtered again."""

from functools import cache

import pytest
import torch
from torchrl.objectives import DDPGLoss

from tests.objectives.test_torchrl_losses import with_other_beliefs
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
    """Returns the program's names after it ran, with the small setting of the page."""
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


@pytest.mark.slow
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


@pytest.mark.parametrize("name", ["sac", pytest.param("ddpg", marks=pytest.mark.slow)])
def test_stored_beliefs_inside_a_slice_have_no_effect(name):
    names = run(name)
    losses = []
    batch = slices(names)
    for stored in (batch, with_other_beliefs(batch)):
        torch.manual_seed(3)
        losses.append(names["loss"](names["filtered"](stored.clone())))
    for key in set(losses[0].keys()) & {"loss_actor", "loss_qvalue", "loss_value"}:
        assert losses[0][key].equal(losses[1][key])
        assert losses[0][key] != 0
