"""Delayed actions: the latency between choice and execution."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torch_denkf._arguments import Checked
from torch_denkf._checks import check_count
from torch_denkf._registered import diagnosis

__all__ = ["LateActions"]


class LateActions(Checked, Transform):
    """Delays each action by some steps, like the latency of sensing, inference and a bus on a robot.

    The actions under way are an entry ``[*B, K, A]``, ``("under_way", "action")``: the first is executed now, the one
    that is chosen now is appended after the last. An episode begins with zeros. The transform is stateless: the entry
    is part of the observation spec and of the state spec. A filter's transform or policy after it is driven by the
    executed action. Stored data have the chosen actions: for a loss, use ``data.set("action", data["under_way",
    "action"][..., 0, :])``.

    Args:
        steps: K, latency in steps.
        action_key: key of the action.

    Raises:
        ValueError: if ``steps`` is no positive number.
        KeyError: if a step's tensordict lacks the actions under way.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torch_denkf.envs import NoisyPendulumEnv
        >>> rollout = TransformedEnv(NoisyPendulumEnv(noise=0.1), LateActions(3)).rollout(20)
        >>> bool((rollout["under_way", "action"][3:, 0] == rollout["action"][:-3]).all())
        True
    """

    def __init__(self, steps: int, *, action_key: NestedKey = "action"):
        check_count("steps", steps)
        key = unravel_key(action_key)
        names = (key,) if isinstance(key, str) else key
        super().__init__(in_keys_inv=[key], out_keys_inv=[key], out_keys=[("under_way", *names)])
        self.steps, self.action_key, self._next_key = steps, key, ("_under_way", *names)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        chosen, key = tensordict.get(self.action_key, None), self.out_keys[0]
        if chosen is None:  # a reset
            return tensordict
        waiting = tensordict.get(key, None)
        if waiting is None:
            cure = "Start from env.reset(), and pass on what step_mdp() returns."
            raise diagnosis().missing_entry("LateActions", [key], tensordict.keys(True, True), cure)
        dim = chosen.ndim - 1
        tensordict.set(self._next_key, torch.cat([waiting.narrow(dim, 1, self.steps - 1), chosen.unsqueeze(dim)], dim))
        return tensordict.set(self.action_key, waiting.select(dim, 0))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self.out_keys[0], tensordict.get(self._next_key))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return tensordict_reset.set(self.out_keys[0], self._zeros().zero())

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        masks = [tensordict.get(key, None) for key in (["_reset"] if self.parent is None else self.parent.reset_keys)]
        rows = torch.stack([m.reshape(*tensordict.batch_size, -1).any(-1) for m in masks if m is not None]).any(0)
        waiting: Tensor = tensordict_reset.get(self.out_keys[0])
        return tensordict_reset.set(self.out_keys[0], waiting.masked_fill(expand_as_right(rows, waiting), 0))

    def _zeros(self) -> Unbounded:
        action = self.parent.full_action_spec[self.action_key]
        shape = (*action.shape[:-1], self.steps, action.shape[-1])
        return Unbounded(shape, dtype=action.dtype, device=action.device)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the actions under way."""
        observation_spec[self.out_keys[0]] = self._zeros()
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Adds them to the state spec, which passes them to workers."""
        if input_spec.get("full_state_spec", None) is None:
            input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
        input_spec["full_state_spec"][self.out_keys[0]] = self._zeros()
        return input_spec
