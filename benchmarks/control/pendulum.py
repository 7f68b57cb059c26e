"""The filter of the pendulum, with known kinematics and a learned acceleration."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_denkf import modules as m
from torch_denkf.envs import NoisyPendulumEnv
from torch_denkf.filters import DEnKF

STEPS = 200  # of an episode


def world(count: int, noise: float, missing: float, seed: int) -> NoisyPendulumEnv:
    """Returns a batch of pendulums."""
    return NoisyPendulumEnv(noise, missing=missing, max_steps=STEPS, batch_size=[count], seed=seed)


class Swing(m.Transition):
    """The filter's motion: a network predicts the change of the velocity, which turns the angle."""

    def __init__(self):
        network = nn.Sequential(nn.Linear(4, 32), nn.Tanh(), nn.Linear(32, 1))
        super().__init__(network, [("belief", "ensemble"), "action"], [("forecast", "ensemble")])

    def compute(self, ensemble: Tensor, action: Tensor) -> Tensor:
        """Returns states ``[*B, E, 3]`` (cosine, sine, rad/s) one step on, with torques ``[*B, 1]``."""
        cos, sin, velocity = ensemble.split(1, -1)
        angle = torch.atan2(sin, cos)
        torque = (action / NoisyPendulumEnv.MAX_TORQUE).unsqueeze(-2).expand_as(velocity)
        features = [angle.cos(), angle.sin(), velocity / NoisyPendulumEnv.MAX_SPEED, torque]
        velocity = velocity + self.module(torch.cat(features, -1))
        velocity = velocity.clamp(-NoisyPendulumEnv.MAX_SPEED, NoisyPendulumEnv.MAX_SPEED)
        angle = angle + NoisyPendulumEnv.DT * velocity
        return torch.cat([angle.cos(), angle.sin(), velocity], -1)


def unlearned_filter(members: int) -> DEnKF:
    """Returns a filter with a known measurement model; acceleration and both noises are learned."""
    q = m.ConstantNoise([0.3], trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return DEnKF(
        transition=m.NoisyTransition(Swing(), q, dims=[2], before=True),
        sensor=None,
        observation=m.Select([0, 1]),
        noise=m.ConstantNoise([0.2] * 2, trainable=True, in_key="observation"),
        analysis=m.EnsembleAnalysis("etkf", observation_key="observation"),
        initial=m.GaussianPrior([0.0] * 3, [0.7, 0.7, 0.6], ensemble_size=members),
        update_at_reset=True,
    )
