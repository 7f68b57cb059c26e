"""Schedules against torch's own, lengths and groups by hand."""

import pytest
import torch
from torch import nn

from torch_denkf.training import Stage
from torch_denkf.training.stage import only_trainable, parameters_without


def rates(stage, net):
    optimiser, schedule = stage.optimiser(stage.groups(net))
    seen = []
    for _ in range(stage.updates):
        seen.append([group["lr"] for group in optimiser.param_groups])
        optimiser.step()
        schedule.step()
    return seen


@pytest.mark.parametrize("schedule", ["one_cycle", "cosine", "constant", "steps"])
def test_learning_rates_are_those_of_torch(schedule):
    net = nn.Sequential(nn.Linear(1, 1), nn.Linear(1, 1))
    steps = lambda optimiser, updates: torch.optim.lr_scheduler.StepLR(optimiser, updates // 4)  # noqa: E731
    groups = [{"params": net[0].parameters(), "lr": 1e-4}, {"params": net[1].parameters()}]
    stage = Stage("fit", None, None, 20, groups, lr=3e-3, schedule=steps if schedule == "steps" else schedule)
    for column, lr in ((0, 1e-4), (1, 3e-3)):
        optimiser = torch.optim.SGD([nn.Parameter(torch.zeros(1))], lr=lr, momentum=0.9)
        oracle = {
            "one_cycle": lambda o: torch.optim.lr_scheduler.OneCycleLR(o, o.param_groups[0]["lr"], total_steps=20),
            "cosine": lambda o: torch.optim.lr_scheduler.CosineAnnealingLR(o, 20),
            "constant": lambda o: torch.optim.lr_scheduler.ConstantLR(o, 1.0),
            "steps": lambda o: torch.optim.lr_scheduler.StepLR(o, 5),
        }[schedule](optimiser)
        expected = []
        for _ in range(20):
            expected.append(oracle.get_last_lr()[0])
            optimiser.step()
            oracle.step()
        assert [row[column] for row in rates(stage, net)] == pytest.approx(expected, rel=1e-12)


def test_lengths_grow():
    stage = Stage("fit", None, None, 10, lengths={4: 16, 0: 2, 7: 32})
    assert [stage.length(update) for update in range(10)] == [2] * 4 + [16] * 3 + [32] * 3
    assert Stage("fit", None, None, 10).length(3) is None


def test_loss_selects_the_trained_parameters():
    net = nn.Sequential(nn.Linear(1, 1), nn.Linear(1, 1))
    net[0].bias.requires_grad_(False)
    assert Stage("fit", net[0], None, 1).groups(net)[0]["params"] == [net[0].weight]
    whole = Stage("fit", lambda batch: {}, None, 1).groups(net)[0]["params"]
    assert [id(p) for p in whole] == [id(p) for p in (net[0].weight, net[1].weight, net[1].bias)]
    once = Stage("fit", None, None, 1, (p for p in [net[1].bias]))  # a generator can be read once only
    assert once.groups(net) == once.groups(net) == [{"params": [net[1].bias]}]


def test_only_trainable_restores_requires_grad():
    net = nn.Sequential(nn.Linear(1, 1), nn.Linear(1, 1))
    net[0].bias.requires_grad_(False)
    before = [p.requires_grad for p in net.parameters()]
    inside = []

    def fail():
        with only_trainable(net, [net[0].bias]):
            inside.extend(p.requires_grad for p in net.parameters())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fail()
    assert inside == [False, True, False, False]
    assert [p.requires_grad for p in net.parameters()] == before


def test_a_name_that_is_no_module_raises():
    net = nn.ModuleDict({"sensor": nn.Linear(1, 1), "motion": nn.Linear(1, 1)})
    stage = Stage("fit", dict, dict, 1, frozen=["sensor"])
    assert [p for group in stage.groups(net) for p in group["params"]] == list(net["motion"].parameters())
    with pytest.raises(KeyError, match=r"no module.*camera"):
        Stage("fit", dict, dict, 1, frozen=["camera"]).groups(net)
    with pytest.raises(TypeError, match="list of names"):
        Stage("fit", dict, dict, 1, frozen="sensor")


def test_a_stage_with_frozen_modules_trains_nothing_that_no_checkpoint_holds():
    """Raises for a parameter that the loss alone holds, as it does without frozen modules."""
    net, other = nn.ModuleDict({"sensor": nn.Linear(1, 1), "head": nn.Linear(1, 1)}), nn.Parameter(torch.ones(1))
    with pytest.raises(ValueError, match="1 parameters that the trainer's model does not hold"):
        Stage("fit", dict, dict, 1, frozen=["sensor"], parameters=[*net.parameters(), other]).groups(net)


def test_the_initial_belief_may_be_frozen():
    net, initial = nn.Module(), nn.Linear(1, 1)
    net.module, net.initial = nn.ModuleDict({"sensor": nn.Linear(1, 1)}), initial
    assert parameters_without(net, ["initial"]) == list(net.module.parameters())
    assert parameters_without(net, ["sensor"]) == list(initial.parameters())
