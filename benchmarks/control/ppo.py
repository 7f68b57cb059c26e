"""Proximal policy optimisation of one arm, with torchrl's parts; the same settings for all arms of a task."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator, set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from benchmarks.control.arms import Arm, Inputs, reader
from torch_denkf.filters import Filter

WIDTH = 64


@dataclass(frozen=True)
class Settings:
    """Settings of PPO."""

    gamma: float
    lmbda: float
    epochs: int = 10
    minibatch: int = 320  # steps
    slice: int = 40  # steps of a recurrent network's training slices; other networks see steps in any order
    lr: float = 1e-3
    clip: float = 0.2
    reward: float = 1.0  # factor


class Head(nn.Module):
    """Network with two hidden layers on an entry in units of ``scale``."""

    def __init__(self, width: int, outputs: int, scale: Tensor | None = None):
        super().__init__()
        layers = nn.Linear(width, WIDTH), nn.Tanh(), nn.Linear(WIDTH, WIDTH), nn.Tanh(), nn.Linear(WIDTH, outputs)
        self.layers = nn.Sequential(*layers)
        self.register_buffer("scale", torch.ones(1) if scale is None else scale)

    def forward(self, value: Tensor) -> Tensor:
        """Returns outputs ``[*B, outputs]``."""
        return self.layers(value / self.scale)


class ActorHead(Head):
    """Mean and standard deviation of an action; the latter does not depend on the state."""

    def __init__(self, width: int, outputs: int, scale: Tensor | None = None):
        super().__init__(width, outputs, scale)
        self.log_std = nn.Parameter(torch.zeros(outputs))
        with torch.no_grad():
            self.layers[-1].weight.mul_(0.01)
            self.layers[-1].bias.zero_()

    def forward(self, value: Tensor) -> tuple[Tensor, Tensor]:
        """Returns mean and standard deviation, ``[*B, A]`` each."""
        mean = super().forward(value)
        return mean, self.log_std.exp().expand_as(mean)


def networks(arm: Arm, inputs: Inputs) -> tuple[TensorDictModuleBase, TensorDictModuleBase]:
    """Returns an actor, which writes ``"raw"``, and a critic.

    Args:
        arm: of the networks.
        inputs: sizes and units of their inputs and outputs.
    """
    parts = []
    for name, Module, outputs in (("actor", ActorHead, inputs.actions), ("critic", Head, 1)):
        before, key, width, scale = reader(arm, inputs, name)
        parts += [before, Module(width, outputs, scale), [key]]
    actor_before, actor, actor_keys, critic_before, critic, critic_keys = parts
    head = TensorDictModule(actor, actor_keys, ["loc", "scale"])
    policy = ProbabilisticActor(
        TensorDictSequential(*actor_before, head),
        in_keys=["loc", "scale"],
        out_keys=["raw"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    value = TensorDictSequential(*critic_before, ValueOperator(critic, in_keys=critic_keys))
    return policy, value


class PPO:
    """Learns from batches of whole episodes ``[B, T]``.

    Args:
        arm: of the policy. With a memory, actor and critic are trained on slices of time.
        inputs: sizes and units of the networks' inputs and outputs.
        settings: the task's.
        batches: number of batches, over which the learning rate decreases to 5 %.
        filter: of the environment, if the actor's loss trains it, too: it filters slices of time again, each from the
            stored ensemble. The critic reads the belief at collection.

    Attributes:
        actor: writes ``"raw"``.
        critic: writes ``"state_value"``.
        policy: writes ``"action"``, and the memory of the critic.
    """

    ON_POLICY = True  # random actions are not learned from

    def __init__(self, arm: Arm, inputs: Inputs, settings: Settings, batches: int, filter: Filter | None = None):
        self.settings, self.slice = settings, settings.slice if arm.memory or filter is not None else 1
        self.actor, self.critic = networks(arm, inputs)
        clamp = TensorDictModule(lambda raw: inputs.limit * raw.clamp(-1, 1), ["raw"], ["action"])
        self.policy = TensorDictSequential(self.actor, *([self.critic] if arm.memory else []), clamp)
        self.advantage = GAE(
            gamma=settings.gamma,
            lmbda=settings.lmbda,
            value_network=self.critic,
            average_gae=False,
            deactivate_vmap=True,
        )
        self.loss = ClipPPOLoss(
            self.actor if filter is None else ProbabilisticTensorDictSequential(filter, *self.actor),
            self.critic,
            clip_epsilon=settings.clip,
            entropy_bonus=False,
            critic_coeff=0.5,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        self.filtered = [] if filter is None else ["observation", "observed", "action", "belief"]
        self.loss.set_keys(action="raw", sample_log_prob="raw_log_prob")
        self.optimiser = torch.optim.Adam(self.loss.parameters(), lr=settings.lr)
        self.schedule = torch.optim.lr_scheduler.LinearLR(self.optimiser, 1.0, 0.05, batches)

    def update(self, data: TensorDict) -> None:
        """Learns from one batch."""
        s = self.settings
        data = data.exclude("next", "state_value", "actor_memory", "critic_memory").set("next", data["next"].copy())
        data["next", "reward"] = s.reward * data["next", "reward"]
        with torch.no_grad(), set_recurrent_mode(True):
            self.advantage(data)
        keys = [*self.loss.in_keys, "advantage", "value_target", "is_init", *self.filtered]
        slices = data.select(*keys, strict=False).exclude("next").reshape(-1, self.slice)
        for _ in range(s.epochs):
            for part in torch.randperm(len(slices)).split(s.minibatch // self.slice):
                terms = self.loss(slices[part])
                self.optimiser.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(self.loss.parameters(), 0.5)
                self.optimiser.step()
        self.schedule.step()
