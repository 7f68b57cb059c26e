"""The arms: what each reads, and the networks of its policy. All have two layers of 64 units behind it."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import GRUModule, IndependentNormal, LSTMModule, ProbabilisticActor, ValueOperator

WIDTH = 64


@dataclass(frozen=True)
class Arm:
    """What an arm reads.

    Attributes:
        keys: entries of the environment.
        stack: readings side by side.
        memory: ``"lstm"`` or ``"gru"``, or nothing.
        filter: ``"learned"`` from readings, ``"taught"`` with the simulator's states, ``"exact"``, or nothing.
    """

    keys: tuple[NestedKey, ...]
    stack: int = 1
    memory: str = ""
    filter: str = ""


MEAN, VAR, ENSEMBLE = ("belief", "mean"), ("belief", "var"), ("belief", "ensemble")
ARMS = {
    "last reading": Arm(("seen",)),
    "four readings": Arm(("seen",), stack=4),
    "LSTM": Arm(("seen",), memory="lstm"),
    "GRU": Arm(("seen",), memory="gru"),
    "belief mean": Arm((MEAN,), filter="learned"),
    "belief mean, spread": Arm((MEAN, VAR), filter="learned"),
    "ensemble": Arm((ENSEMBLE,), filter="learned"),
    "belief mean, taught": Arm((MEAN,), filter="taught"),
    "Kalman": Arm((MEAN,), filter="exact"),
    "truth": Arm(("state",)),
}


class Head(nn.Module):
    """Two hidden layers on one or two entries in units of ``scale``; of an ensemble, on its members' mean features."""

    def __init__(self, width: int, outputs: int, scale: Tensor | None = None, kind: str = "vector"):
        super().__init__()
        self.first, self.second, self.last = nn.Linear(width, WIDTH), nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, outputs)
        self.register_buffer("scale", scale)
        self.kind = kind

    def forward(self, value: Tensor, variance: Tensor | None = None) -> Tensor:
        """Outputs ``[*B, outputs]``."""
        if self.scale is not None:
            value = value / self.scale
            if variance is not None:
                value = torch.cat([value, variance.sqrt() / self.scale], -1)
        hidden = self.first(value).tanh()
        if self.kind == "ensemble":
            hidden = hidden.mean(-2)
        return self.last(self.second(hidden).tanh())


class ActorHead(Head):
    """Mean and standard deviation of an action; the latter is the same everywhere."""

    def __init__(self, width: int, outputs: int, scale: Tensor | None = None, kind: str = "vector"):
        super().__init__(width, outputs, scale, kind)
        self.log_std = nn.Parameter(torch.zeros(outputs))
        with torch.no_grad():
            self.last.weight.mul_(0.01)
            self.last.bias.zero_()

    def forward(self, value: Tensor, variance: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Two times ``[*B, A]``."""
        mean = super().forward(value, variance)
        return mean, self.log_std.exp().expand_as(mean)


def _memory(kind: str, width: int, name: str) -> TensorDictModuleBase:
    """An LSTM or a GRU of torchrl's on what is seen."""
    states = [f"{name}_hidden", f"{name}_cell"][: 2 if kind == "lstm" else 1]
    keys = {"in_keys": ["seen", *states], "out_keys": [f"{name}_memory", *(("next", key) for key in states)]}
    return {"lstm": LSTMModule, "gru": GRUModule}[kind](input_size=width, hidden_size=WIDTH, **keys)


def networks(arm: Arm, seen: int, actions: int, scale: Tensor) -> tuple[TensorDictModuleBase, TensorDictModuleBase]:
    """Actor, which writes ``"raw"``, and critic.

    Args:
        arm: whose they are.
        seen: width of the entry.
        actions: A.
        scale: what a state is divided by, ``[S]``.
    """
    parts = []
    for name, Module, outputs in (("actor", ActorHead, actions), ("critic", Head, 1)):
        if arm.memory:
            module = Module(WIDTH, outputs)
            keys, before = [f"{name}_memory"], [_memory(arm.memory, seen, name)]
        else:
            states = arm.keys[0] != "seen"
            width = len(arm.keys) * len(scale) if states else arm.stack * seen
            module = Module(width, outputs, scale if states else None, "ensemble" if ENSEMBLE in arm.keys else "vector")
            keys, before = ["stack" if arm.stack > 1 else arm.keys[0], *arm.keys[1:]], []
        parts.append((module, keys, before))
    (actor, actor_keys, actor_before), (critic, critic_keys, critic_before) = parts
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


def clamp(limit: float) -> TensorDictModule:
    """Turns what a policy drew into an action."""
    return TensorDictModule(lambda raw: limit * raw.clamp(-1, 1), ["raw"], ["action"])
