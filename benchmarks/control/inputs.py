"""What an arm's networks read of an environment."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded
from torchrl.envs.transforms import Transform


class Seen(Transform):
    """Writes ``"seen"`` ``[*B, O + 1 + A]``: the last reading that came, whether it came now, and the last action.

    All that a filter reads in a step, without NaN.

    Args:
        scale: what a reading is divided by, a number or ``[O]``.
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
