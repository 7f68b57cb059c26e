"""Soft actor-critic of one arm, with torchrl's parts; the same settings for all arms."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal, ValueOperator, set_recurrent_mode
from torchrl.objectives import SACLoss, SoftUpdate

from benchmarks.control.arms import Arm, Inputs, reader
from benchmarks.control.learning import refiltered
from torch_denkf.filters import Filter


@dataclass(frozen=True)
class Settings:
    """Settings of SAC."""

    gamma: float = 0.99
    every: int = 5  # environment steps for each update
    batch: int = 256  # steps, in any order
    recurrent_batch: int = 500  # steps of a recurrent network, in slices
    slice: int = 50  # steps of a recurrent network's training slices
    units: int = 128  # of a hidden layer
    lr: float = 1e-3
    target: float = 0.995  # share of the target networks' parameters that an update keeps


class Scaled(nn.Module):
    """Network with two hidden layers on an entry in units of ``scale``, and on the action if one is given."""

    def __init__(self, width: int, outputs: int, units: int, scale: Tensor | None):
        super().__init__()
        self.layers = MLP(width, outputs, num_cells=[units, units], activation_class=nn.ReLU)
        self.register_buffer("scale", torch.ones(1) if scale is None else scale)

    def forward(self, value: Tensor, *action: Tensor) -> Tensor:
        """Returns outputs ``[*B, outputs]``."""
        return self.layers(torch.cat([value / self.scale, *action], -1))


def networks(arm: Arm, inputs: Inputs, units: int) -> tuple[TensorDictModuleBase, TensorDictModuleBase]:
    """Returns an actor, which writes ``"action"``, and a critic, which reads it."""
    before, key, width, scale = reader(arm, inputs, "actor")
    head = nn.Sequential(Scaled(width, 2 * inputs.actions, units, scale), NormalParamExtractor(scale_lb=1e-3))
    actor = ProbabilisticActor(
        TensorDictSequential(*before, TensorDictModule(head, [key], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -inputs.limit, "high": inputs.limit},
        return_log_prob=False,
    )
    before, key, width, scale = reader(arm, inputs, "critic")
    value = ValueOperator(Scaled(width + inputs.actions, 1, units, scale), in_keys=[key, "action"])
    return actor, TensorDictSequential(*before, value)


class SAC:
    """Learns from all episodes ``[B, T]`` so far.

    Args:
        arm: of the policy. With a memory, actor and critics have one each, and are trained on slices of time.
        inputs: sizes and units of the networks' inputs and outputs.
        settings: the task's.
        batches: number of batches to come.

    Attributes:
        actor: writes ``"action"``.
        critic: the first of two.
        policy: the actor.
    """

    ON_POLICY = False  # random actions are learned from, too

    def __init__(self, arm: Arm, inputs: Inputs, settings: Settings, batches: int):
        self.settings, self.batches = settings, batches
        self.slice = settings.slice if arm.memory else 1
        self.actor, self.critic = networks(arm, inputs, settings.units)
        self.policy = self.actor
        self.keys = ["action", ("next", "reward"), *_both("is_init", "done", "terminated"), *_both(*self.actor.in_keys)]
        if arm.filter:
            self.keys += _both("observation", "observed")  # to filter again
        self.loss = SACLoss(
            self.actor,
            self.critic,
            loss_function="l2",
            target_entropy=-float(inputs.actions),
            deactivate_vmap=bool(arm.memory),
        )
        self.loss.make_value_estimator(gamma=settings.gamma)
        self.target = SoftUpdate(self.loss, eps=settings.target)
        self.optimiser = torch.optim.Adam(self.loss.parameters(), lr=settings.lr, fused=True)
        self.buffer: TensorDictReplayBuffer | None = None

    def refilter(self, filter: Filter) -> None:
        """Replaces the beliefs stored at collection by those of the present filter."""
        if self.buffer is None:
            return
        data = refiltered(filter, self.buffer[:].select(*self.keys).clone().reshape(-1, self.steps))
        self.buffer.empty()
        self.buffer.extend(data.reshape(-1))

    def update(self, data: TensorDict) -> None:
        """Stores a batch of episodes, and learns."""
        data = data.select(*self.keys)
        if self.buffer is None:
            self.steps, self.buffer = data.shape[1], self._empty_buffer(data)
        self.buffer.extend(data.reshape(-1))
        for _ in range(data.numel() // self.settings.every):
            sample = self.buffer.sample().reshape(-1, self.slice)
            with set_recurrent_mode(True):
                terms = self.loss(sample)
            self.optimiser.zero_grad()
            (terms["loss_actor"] + terms["loss_qvalue"] + terms["loss_alpha"]).backward()
            self.optimiser.step()
            self.target.step()

    def _empty_buffer(self, data: TensorDict) -> TensorDictReplayBuffer:
        storage = LazyTensorStorage(self.batches * data.numel())
        if self.slice == 1:
            return TensorDictReplayBuffer(storage=storage, batch_size=self.settings.batch)
        sampler = SliceSampler(slice_len=self.slice, end_key=("next", "done"), cache_values=True)
        return TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=self.settings.recurrent_batch)


def _both(*keys: NestedKey) -> list[NestedKey]:
    """Returns keys before and after a step."""
    return [*keys, *(unravel_key(("next", key)) for key in keys)]
