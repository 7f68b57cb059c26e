"""dm_control's reacher with noisy encoders: the environment of the filter ``reacher``."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Composite
from torchrl.envs import CatTensors, Compose, DMControlEnv, DoubleToFloat, TransformedEnv
from torchrl.envs.transforms import Transform

__all__ = ["ENCODER_STD", "NoisyEncoders", "reacher_env"]

ENCODER_STD = 0.05  # rad


class NoisyEncoders(Transform):
    """Adds white noise to the joint positions, as ``"encoder"`` ``[*B, 2]`` rad.

    Args:
        std: standard deviation of the noise, in rad.
    """

    def __init__(self, std: float = ENCODER_STD):
        super().__init__(in_keys=["position"], out_keys=["encoder"])
        self.std = std

    def _apply_transform(self, position: torch.Tensor) -> torch.Tensor:
        return position + self.std * torch.randn_like(position)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Returns the spec with the encoders."""
        observation_spec["encoder"] = observation_spec["position"].clone()
        return observation_spec


def reacher_env(seed: int = 0) -> TransformedEnv:
    """Returns a reacher with a noisy ``"encoder"`` (0.05 rad); ``"state"`` is the true state, for training and tests.

    Args:
        seed: of the environment; the noise uses torch's generator.

    Example:
        >>> sorted(reacher_env().rollout(2)["state"].shape)
        [2, 4]
    """
    env = TransformedEnv(
        DMControlEnv("reacher", "easy"),
        Compose(
            DoubleToFloat(),
            NoisyEncoders(),
            CatTensors(in_keys=["position", "velocity"], out_key="state", del_keys=False),
        ),
    )
    env.set_seed(seed)
    return env
