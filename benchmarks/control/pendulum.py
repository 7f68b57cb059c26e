"""Gymnasium's Pendulum-v1, many at once, read by noisy cosines and sines of the angle: nobody reads the velocity."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded

from torch_denkf import modules as m
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.filters import DEnKF

STEPS, DT, SPEED, TORQUE = 200, 0.05, 8.0, 2.0  # of an episode; s; rad/s; Nm
GRAVITY, MASS, LENGTH = 10.0, 1.0, 1.0  # m/s^2, kg, m


def turn(cos: Tensor, sin: Tensor, velocity: Tensor) -> Tensor:
    """States ``[*, 3]`` (cosine, sine, rad/s) after a time step at a velocity, ``[*, 1]`` each."""
    angle = torch.atan2(sin, cos) + DT * velocity
    return torch.cat([angle.cos(), angle.sin(), velocity], -1)


class Pendulum(LinearGaussianEnv):
    """Readings, masks and time limit are those of a linear system, the motion and the reward are Pendulum-v1's.

    The state is [cosine, sine, velocity in rad/s], ``[*B, 3]``; the angle is 0 where the pendulum stands upright.

    Args:
        count: pendulums.
        noise: standard deviation of the readings of cosine and sine.
        missing: share of the readings that do not come.
        seed: of the environment's own generator.
    """

    def __init__(self, count: int, noise: float, missing: float = 0.0, seed: int = 0):
        one = torch.eye(3)
        super().__init__(
            one,
            one[:2],
            [0.0] * 3,
            [noise] * 2,
            control=one[:, 2:],  # a torque
            missing=missing,
            max_steps=STEPS,
            batch_size=[count],
            seed=seed,
        )
        self.action_spec = Bounded(-TORQUE, TORQUE, (count, 1))

    def _reset(self, tensordict: TensorDictBase | None = None, **_) -> TensorDict:
        uniform = 2 * torch.rand(*self.batch_size, 2, generator=self.rng) - 1
        angle, velocity = torch.pi * uniform[..., :1], uniform[..., 1:]
        state = torch.cat([angle.cos(), angle.sin(), velocity], -1)
        return self._emit(state, torch.zeros(*self.batch_size, 1, dtype=torch.int64))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        cos, sin, velocity = tensordict["state"].split(1, -1)
        torque = tensordict["action"].clamp(-TORQUE, TORQUE)
        cost = torch.atan2(sin, cos).square() + 0.1 * velocity.square() + 0.001 * torque.square()
        push = 1.5 * GRAVITY / LENGTH * sin + 3.0 / (MASS * LENGTH**2) * torque
        moved = turn(cos, sin, (velocity + DT * push).clamp(-SPEED, SPEED))
        return self._emit(moved, tensordict["step"] + 1).set("reward", -cost)


class Swing(m.SubModel):
    """The filter's motion: a network says how the velocity changes, the velocity turns the angle."""

    def __init__(self):
        network = nn.Sequential(nn.Linear(4, 32), nn.Tanh(), nn.Linear(32, 1))
        super().__init__(network, [("belief", "ensemble"), "action"], [("forecast", "ensemble")])

    def compute(self, ensemble: Tensor, action: Tensor) -> Tensor:
        """States ``[*B, E, 3]`` one step on, with torques ``[*B, 1]``."""
        cos, sin, velocity = ensemble.split(1, -1)
        angle = torch.atan2(sin, cos)
        torque = (action / TORQUE).unsqueeze(-2).expand_as(velocity)
        change = self.module(torch.cat([angle.cos(), angle.sin(), velocity / SPEED, torque], -1))
        return turn(cos, sin, velocity + change)


def unlearned_filter(members: int) -> DEnKF:
    """A filter that knows what is read and how a velocity turns an angle; acceleration and noises are learned."""
    q = m.ConstantNoise([0.3], trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return DEnKF(
        transition=m.NoisyTransition(Swing(), q, dims=[2], before=True),
        sensor=None,
        observation=m.Select([0, 1]),
        noise=m.ConstantNoise([0.2] * 2, trainable=True, in_key="observation"),
        analysis=m.EnsembleAnalysis("etkf", sensor_key="observation"),
        initial=m.GaussianPrior([0.0] * 3, [0.7, 0.7, 0.6], ensemble_size=members),
        update_at_reset=True,
    )
