"""Zero-order hold of missing readings, for networks that need a reading in each step."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import expand_as_right
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs.transforms import Transform

from torch_denkf._arguments import Checked
from torch_denkf._registered import diagnosis

__all__ = ["HoldReading"]


class HoldReading(Checked, Transform):
    """Adds the last reading that arrived (zero-order hold), for networks without a filter.

    A missing reading is NaN or zero. A filter skips it; an LSTM that reads NaN returns NaN from then on, without an
    error. Before the first reading of an episode the held value is zero. The transform is stateless: the held reading
    is part of the observation spec and of the state spec, so that workers, partial resets and stored data include it.

    Args:
        in_key: the reading ``[*B, ...]``.
        observed_key: its mask, ``[*B, 1]``, or that of single components, ``[*B, O]``; True if it has arrived.
        out_key: key of the held reading, of the reading's shape.

    Raises:
        KeyError: if there is no reading or no mask, or if a step's tensordict lacks the held reading.

    Example:
        >>> from torchrl.envs import TransformedEnv
        >>> from torch_denkf.envs import NoisyPendulumEnv
        >>> env = TransformedEnv(NoisyPendulumEnv(noise=0.1, missing=0.5), HoldReading())
        >>> rollout = env.rollout(20)
        >>> bool(rollout["observation"].isnan().any()), bool(rollout["held"].isnan().any())
        (True, False)
    """

    def __init__(
        self,
        in_key: NestedKey = "observation",
        *,
        observed_key: NestedKey = "observed",
        out_key: NestedKey = "held",
    ):
        super().__init__(in_keys=[in_key, observed_key], out_keys=[out_key])

    def _entry(self, tensordict: TensorDictBase, key: NestedKey, cure: str) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            raise diagnosis().missing_entry("HoldReading", [key], tensordict.keys(True, True), cure)
        return value

    def _write(self, tensordict: TensorDictBase, before: Tensor | None) -> TensorDictBase:
        reading = self._entry(tensordict, self.in_keys[0], "Set in_key=.")
        cure = "Set observed_key=, or put what writes the mask, as MissingFrames does, before this transform."
        observed = self._entry(tensordict, self.in_keys[1], cure)
        observed = observed.reshape(*observed.shape, *(1,) * (reading.ndim - observed.ndim))
        before = torch.zeros_like(reading) if before is None else before
        return tensordict.set(self.out_keys[0], torch.where(observed, reading, before))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        cure = "Start from env.reset(), and pass on what step_mdp() returns."
        before = self._entry(tensordict, self.out_keys[0], cure)
        return self._write(next_tensordict, before)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._write(tensordict_reset, None)  # the environment restores the other rows

    def _reset_on_native_autoreset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        masks = [tensordict.get(key, None) for key in (["_reset"] if self.parent is None else self.parent.reset_keys)]
        rows = [mask.reshape(*tensordict.batch_size, -1).any(-1) for mask in masks if mask is not None]
        before, out = tensordict_reset.get(self.out_keys[0]), self._write(tensordict_reset, None)
        now = out.get(self.out_keys[0])
        return out.set(self.out_keys[0], torch.where(expand_as_right(torch.stack(rows).any(0), now), now, before))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Returns data that have the held reading, as from an environment, unchanged.

        Raises:
            KeyError: if they lack it.
        """
        cure = "Append HoldReading to the environment, not to a replay buffer."
        self._entry(tensordict, self.out_keys[0], cure)
        return tensordict

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the held reading."""
        reading = observation_spec[self.in_keys[0]]
        observation_spec[self.out_keys[0]] = Unbounded(reading.shape, dtype=reading.dtype, device=reading.device)
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Adds it to the state spec, which passes it to workers."""
        if input_spec.get("full_state_spec", None) is None:
            input_spec["full_state_spec"] = Composite(shape=input_spec.shape, device=input_spec.device)
        held = self.parent.full_observation_spec[self.in_keys[0]]
        input_spec["full_state_spec"][self.out_keys[0]] = Unbounded(held.shape, dtype=held.dtype, device=held.device)
        return input_spec
