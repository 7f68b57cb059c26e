"""Proximal policy optimisation of one arm, with torchrl's parts; the same settings for all arms of a task."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.modules import set_recurrent_mode
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE


@dataclass(frozen=True)
class Settings:
    """Of PPO."""

    gamma: float
    lmbda: float
    epochs: int = 10
    minibatch: int = 320  # steps
    slice: int = 40  # steps that a recurrent network is trained through; others see steps in any order
    lr: float = 1e-3
    clip: float = 0.2
    reward: float = 1.0  # factor


class PPO:
    """Learns from batches of whole episodes ``[B, T]``.

    Args:
        policy: writes ``"raw"``.
        critic: writes ``"state_value"``.
        settings: the task's.
        batches: that will come; the learning rate goes down to 5 % meanwhile.
        recurrent: whether both have a memory, and are trained on slices of time.
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        critic: TensorDictModuleBase,
        settings: Settings,
        batches: int,
        recurrent: bool,
    ):
        self.settings, self.slice = settings, settings.slice if recurrent else 1
        self.advantage = GAE(
            gamma=settings.gamma, lmbda=settings.lmbda, value_network=critic, average_gae=False, deactivate_vmap=True
        )
        self.loss = ClipPPOLoss(
            policy,
            critic,
            clip_epsilon=settings.clip,
            entropy_bonus=False,
            critic_coeff=0.5,
            loss_critic_type="l2",
            normalize_advantage=True,
        )
        self.loss.set_keys(action="raw", sample_log_prob="raw_log_prob")
        self.optimiser = torch.optim.Adam(self.loss.parameters(), lr=settings.lr)
        self.schedule = torch.optim.lr_scheduler.LinearLR(self.optimiser, 1.0, 0.05, batches)

    def update(self, data: TensorDict) -> None:
        """One batch."""
        s = self.settings
        data = data.exclude("next", "state_value", "actor_memory", "critic_memory").set("next", data["next"].copy())
        data["next", "reward"] = s.reward * data["next", "reward"]
        with torch.no_grad(), set_recurrent_mode(True):
            self.advantage(data)
        keys = [*self.loss.in_keys, "advantage", "value_target", "is_init"]
        slices = data.select(*keys, strict=False).exclude("next").reshape(-1, self.slice)
        for _ in range(s.epochs):
            for part in torch.randperm(len(slices)).split(s.minibatch // self.slice):
                terms = self.loss(slices[part])
                self.optimiser.zero_grad()
                (terms["loss_objective"] + terms["loss_critic"]).backward()
                nn.utils.clip_grad_norm_(self.loss.parameters(), 0.5)
                self.optimiser.step()
        self.schedule.step()
