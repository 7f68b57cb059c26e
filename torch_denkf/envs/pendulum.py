"""Batched version of Gymnasium's Pendulum-v1 with a noisy encoder."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded

from torch_denkf.envs.linear import LinearGaussianEnv

__all__ = ["NoisyPendulumEnv"]


class NoisyPendulumEnv(LinearGaussianEnv):
    r"""Gymnasium's Pendulum-v1 with noisy observations of the angle, and without observations of the velocity.

    The motor is too weak to lift the pendulum at once. The angle :math:`\theta` is 0 in the upright position:

    .. math::
        \dot\theta_{t+1} = \mathrm{clip}(\dot\theta_t + \Delta t (15 \sin \theta_t + 3 u_t), \pm 8), \quad
        \theta_{t+1} = \theta_t + \Delta t \dot\theta_{t+1}

    with :math:`\Delta t` = 0.05 s and a torque of at most 2 Nm. The reward is
    :math:`-(\theta^2 + 0.1 \dot\theta^2 + 0.001 u^2)` before the step. Episodes begin at any angle, with at most
    1 rad/s.

    Observations are ``"state"`` ``[*B, 3]`` (cosine, sine, velocity in rad/s), ``"observation"`` ``[*B, 2]`` (cosine
    and sine with noise, NaN where missing) and ``"observed"`` ``[*B, 1]``, as in :class:`LinearGaussianEnv`. The
    ``"action"`` is ``[*B, 1]`` in Nm.

    Args:
        noise: standard deviation of the reading of the cosine, and of that of the sine.
        missing: probability that a reading is missing.
        max_steps: length of an episode.
        batch_size: ``*B``.
        seed: seed of the environment's generator.

    Reference:
        ``gymnasium/envs/classic_control/pendulum.py`` in Gymnasium 1.0.

    Example:
        >>> env = NoisyPendulumEnv(noise=0.1, batch_size=[3])
        >>> env.rollout(5)["next", "observation"].shape
        torch.Size([3, 5, 2])
    """

    DT, MAX_SPEED, MAX_TORQUE = 0.05, 8.0, 2.0  # s, rad/s, Nm

    def __init__(
        self,
        noise: float = 0.0,
        *,
        missing: float = 0.0,
        max_steps: int = 200,
        batch_size: Sequence[int] = (),
        seed: int = 0,
        device: torch.device | str | None = None,
    ):
        # Readings, masks and the time limit are those of the linear system; motion and reward are overridden.
        one = torch.eye(3)
        super().__init__(
            one,
            one[:2],
            [0.0] * 3,
            [noise] * 2,
            control=one[:, 2:],
            missing=missing,
            max_steps=max_steps,
            batch_size=batch_size,
            seed=seed,
            device=device,
        )
        dtype = torch.get_default_dtype()
        self.action_spec = Bounded(-self.MAX_TORQUE, self.MAX_TORQUE, (*self.batch_size, 1), dtype=dtype)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDict:
        uniform = 2 * torch.rand(*self.batch_size, 2, dtype=self.F.dtype, **self._source(self.F)) - 1
        angle, velocity = torch.pi * uniform[..., :1], uniform[..., 1:]
        state = torch.cat([angle.cos(), angle.sin(), velocity], -1)
        return self._emit(state, state.new_zeros(*self.batch_size, 1, dtype=torch.int64))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        cos, sin, velocity = tensordict["state"].split(1, -1)
        torque = tensordict["action"].clamp(-self.MAX_TORQUE, self.MAX_TORQUE)
        angle = torch.atan2(sin, cos)
        cost = angle.square() + 0.1 * velocity.square() + 0.001 * torque.square()
        velocity = (velocity + self.DT * (15.0 * sin + 3.0 * torque)).clamp(-self.MAX_SPEED, self.MAX_SPEED)
        angle = angle + self.DT * velocity
        state = torch.cat([angle.cos(), angle.sin(), velocity], -1)
        return self._emit(state, tensordict["step"] + 1).set("reward", -cost)
