"""Shares among the studies of arms: motions with rates and a sensor's slow errors, starts at rest, recipes of both."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from benchmarks.common.recipes import Recipe
from torch_denkf.modules import LearnedTransition, ScaledNoise, SubModel
from torch_denkf.modules.around import AroundInitial


class StateMotion(Protocol):
    """A network that moves a state: its first numbers are what the sensor reads, the others are rates.

    Attributes:
        size: numbers of the state.
        read: numbers that the sensor reads.
        fading: of a bias in a step, before training.
        actions: whether commands follow the state in its input.
    """

    size: int
    read: int
    fading: float
    actions: bool

    def __call__(self, features: Tensor) -> Tensor:
        """States ``[*, size]`` one step on."""


class WithBias(nn.Module):
    r"""The motion of a state that also holds the sensor's slow errors, which fade: :math:`b_t = \rho \circ b_{t-1}`.

    A sensor that reads a pose wrongly reads it wrongly in the next frame, too. A filter that takes its errors for white
    noise believes them more with each frame; here they are part of the state, and the reading is state plus bias
    ("coloured measurement noise": Bryson & Henrikson 1968).

    Args:
        motion: of the state without them.
    """

    def __init__(self, motion: StateMotion):
        super().__init__()
        self.motion = motion
        self.fading = nn.Parameter(torch.full((motion.read,), motion.fading).logit())

    def forward(self, features: Tensor) -> Tensor:
        """States ``[*, size + read]`` of such states, or of states and commands."""
        size, whole = self.motion.size, self.motion.size + self.motion.read
        moved = self.motion(torch.cat([features[..., :size], features[..., whole:]], -1))
        return torch.cat([moved, self.fading.sigmoid() * features[..., size:whole]], -1)


class AtRest(AroundInitial):
    """An initial belief around the numbers that a sensor reads, of something that does not move.

    Args:
        initial: a belief around the filters' state.
        size: of the filters' state; further numbers are zero, and those beyond it are left out.
        input_dim: D.
        state_key: ``[*B, D]``, or the filters' state.
    """

    place = "initial"

    def __init__(self, initial: TensorDictModuleBase, size: int, input_dim: int, state_key: NestedKey = "state"):
        super().__init__(initial, [state_key], optional_keys=())
        self.size = self.state_dim = size
        self.input_dim = input_dim

    def on_entries(self, entries, call):
        """The belief."""
        (key,) = self.in_keys
        state = self.required(entries, key)
        state = nn.functional.pad(state, (0, self.size - state.shape[-1]))
        return self.run_inside({**entries, key: state}, call)


class ArmRecipe(Recipe):
    """A filter whose motion was trained before.

    Attributes:
        actions: whether the motion reads the commands.
        bias: whether the state holds the sensor's slow errors.
        motion: trained before.
        process_std: what motion and bias do not know in a step before training, for each of ``noisy``.
        noisy: dimensions of the state that the process noise acts on.
        rates: those of them that are rates, one for each moving number; or accelerations, or what else drives these.
        moved: dimensions that the noise of ``rates`` moves in the same step, one after the other; by default the first.
    """

    actions = False
    bias = True
    motion: StateMotion
    process_std: Tensor
    noisy: list[int]
    rates: list[int]

    @property
    def moved(self) -> Sequence[Sequence[int]]:
        """The first numbers of the state, as many as there are rates."""
        return (range(len(self.rates)),)

    @property
    def size(self) -> int:
        """S, of the state."""
        return self.motion.size + self.motion.read * self.bias

    def transition(self) -> SubModel:
        """The learned motion as a transition of ensembles."""
        network = WithBias(self.motion) if self.bias else self.motion
        return LearnedTransition(network, residual=False, action_key="action" if self.motion.actions else None)

    def process_noise(self) -> SubModel:
        """Q of what is noisy."""
        return ScaledNoise(self._process_noise())

    def _process_noise(self) -> SubModel:
        raise NotImplementedError

    @property
    def state_scale(self) -> Tensor:
        """Units of the loss; what the sensor does not read does not count."""
        return torch.cat([self.unit, torch.full((self.size - len(self.unit),), torch.inf)])
