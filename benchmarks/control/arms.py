"""The arms of the study, and their inputs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs.transforms import Transform
from torchrl.modules import LSTMModule

MEMORY = 64  # units of an LSTM


@dataclass(frozen=True)
class Arm:
    """Input of an arm's policy.

    Attributes:
        key: entry of the environment.
        stack: number of stacked readings.
        memory: whether the policy has an LSTM.
        filter: ``"learned"`` from readings, ``"taught"`` with the simulator's states, ``"exact"``, or nothing.
        end_to_end: whether the loss of the actor trains the filter, too.
    """

    key: NestedKey
    stack: int = 1
    memory: bool = False
    filter: str = ""
    end_to_end: bool = False


MEAN = ("belief", "mean")
ARMS = {
    "last reading": Arm("seen"),
    "four readings": Arm("seen", stack=4),
    "LSTM": Arm("seen", memory=True),
    "belief mean": Arm(MEAN, filter="learned"),
    "belief mean, taught": Arm(MEAN, filter="taught"),
    "belief mean, end to end": Arm(MEAN, filter="learned", end_to_end=True),
    "Kalman": Arm(MEAN, filter="exact"),
    "physics": Arm(MEAN, filter="exact"),
    "truth": Arm("state"),
}


@dataclass(frozen=True)
class Inputs:
    """Sizes and units of the inputs and outputs of an arm's networks.

    Attributes:
        seen: width of the entry ``"seen"``, for arms that read it.
        actions: A.
        scale: divides a state, ``[S]``.
        limit: of an action.
    """

    seen: int
    actions: int
    scale: Tensor
    limit: float


def memory(width: int, name: str) -> LSTMModule:
    """Returns one of torchrl's LSTMs on the entry ``"seen"``."""
    states = [f"{name}_hidden", f"{name}_cell"]
    keys = {"in_keys": ["seen", *states], "out_keys": [f"{name}_memory", *(("next", key) for key in states)]}
    return LSTMModule(input_size=width, hidden_size=MEMORY, **keys)


def reader(arm: Arm, inputs: Inputs, name: str) -> tuple[list[LSTMModule], NestedKey, int, Tensor | None]:
    """Returns the modules in front of an actor or a critic, and the key, width and units of the entry that it reads."""
    if arm.memory:
        return [memory(inputs.seen, name)], f"{name}_memory", MEMORY, None
    if arm.key == "seen":
        return [], "stack" if arm.stack > 1 else "seen", arm.stack * inputs.seen, None
    return [], arm.key, len(inputs.scale), inputs.scale


class Seen(Transform):
    """Writes ``"seen"`` ``[*B, O + 1 + A]``: the last reading that came, whether it came now, and the last action.

    These are all inputs of a filter in a step, without NaN.

    Args:
        scale: divides a reading, a number or ``[O]``.
    """

    def __init__(self, scale: Tensor | float = 1.0):
        super().__init__(in_keys=["observation", "observed"], out_keys=["seen"])
        self.scale = scale

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = tensordict["seen"][..., : next_tensordict["observation"].shape[-1]]
        return self._write(next_tensordict, before, tensordict["action"])

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        reading, action = tensordict_reset["observation"], self.parent.full_action_spec["action"].zero()
        return self._write(tensordict_reset, torch.zeros_like(reading), action)

    def _write(self, tensordict: TensorDictBase, before: Tensor, action: Tensor) -> TensorDictBase:
        observed = tensordict["observed"]
        reading = torch.where(observed, tensordict["observation"] / self.scale, before)
        return tensordict.set("seen", torch.cat([reading, observed.to(reading.dtype), action], -1))

    def transform_observation_spec(self, observation_spec):
        reading, action = observation_spec["observation"].shape, self.parent.full_action_spec["action"].shape
        observation_spec["seen"] = Unbounded((*reading[:-1], reading[-1] + 1 + action[-1]))
        return observation_spec
