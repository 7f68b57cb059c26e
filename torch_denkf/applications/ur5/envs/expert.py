"""The scripted expert of the UR5 table."""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn

from torch_denkf.applications.ur5.envs.table import UR5TableEnv

__all__ = ["UR5Expert"]


class UR5Expert(TensorDictModule):
    """Scripted expert policy: copies ``("expert", "action")`` to ``"action"``, optionally with noise.

    It is **privileged**. From object, goal and home pose, the environment plans a joint trajectory through the task's
    waypoints at reset: straight lines of the tool at minimum jerk (Flash and Hogan 1985), inverse kinematics by damped
    least squares. It emits the next row of the trajectory at each step. The policy has no state, so one policy serves
    any number of environments, in SerialEnv, ParallelEnv and collectors.

    Args:
        env: optional; checked to emit what the expert reads.
        noise: standard deviation of Gaussian noise on the six joints' targets, rad, for more diverse demonstrations;
            0.005 is harmless. The gripper's target has no noise.
        generator: of the noise; torch's own by default.

    Raises:
        KeyError: if ``env`` does not emit ``("expert", "action")``.
        ValueError: if ``noise`` is negative.

    Examples:
        >>> env = UR5TableEnv("push", from_pixels=False, seed=0)
        >>> bool(env.rollout(350, UR5Expert(env, noise=0.005))["next", "success"][-1])
        True
    """

    def __init__(self, env: UR5TableEnv | None = None, *, noise: float = 0.0, generator: torch.Generator | None = None):
        if env is not None and ("expert", "action") not in env.observation_spec.keys(True, True):
            raise KeyError(
                f"{type(env).__name__} does not emit ('expert', 'action'), the privileged plan that UR5Expert follows; "
                "UR5TableEnv does."
            )
        if noise < 0:
            raise ValueError(f"noise is a standard deviation in rad, got {noise}")
        super().__init__(_Follow(noise, generator), in_keys=[("expert", "action")], out_keys=["action"])


class _Follow(nn.Module):
    def __init__(self, noise: float, generator: torch.Generator | None):
        super().__init__()
        self.noise, self.generator = noise, generator

    def forward(self, planned: Tensor) -> Tensor:
        action = planned.clone()
        if self.noise:
            shape = (*planned.shape[:-1], 6)
            draw = torch.randn(shape, generator=self.generator, dtype=planned.dtype, device=planned.device)
            action[..., :6] += self.noise * draw
        return action
