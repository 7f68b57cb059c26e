"""The mountain hike: a walker with noisy readings of the position has to stay on a ridge. Linear and Gaussian."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded

from torch_denkf import modules as m
from torch_denkf.envs import LinearGaussianEnv
from torch_denkf.filters import DEnKF, KalmanFilter

STEPS, STRIDE, PROCESS, START, START_STD = 75, 0.05, 0.025, -0.85, 0.1
RIDGES = (((-0.4, -0.8), (0.16, 0.01)), ((0.0, 0.0), (0.01, 0.64)), ((0.4, 0.8), (0.16, 0.01)))  # means, variances


def altitude(position: Tensor) -> Tensor:
    """Returns the altitude at ``[*, 2]``: three ridges make a path from the lower left to the upper right."""
    ridges = []
    for center, spread in RIDGES:
        mean, variance = position.new_tensor(center), position.new_tensor(spread)
        density = (-0.5 * ((position - mean).square() / variance).sum(-1)).exp()
        ridges.append(density / (2 * torch.pi * variance.prod().sqrt()))
    return -(-torch.stack(ridges).amax(0)).exp() + 0.2 * position.sum(-1) - 0.02


class MountainHike(LinearGaussianEnv):
    """A batch of walkers. The state is the position on the map minus the start, ``[*B, 2]``; the action is a stride.

    Args:
        count: walkers.
        noise: standard deviation of the reading, in units of the map.
        missing: share of missing readings.
        seed: of the environment's own generator.
    """

    def __init__(self, count: int, noise: float, missing: float = 0.0, seed: int = 0):
        one = torch.eye(2)
        super().__init__(
            one,
            one,
            [PROCESS] * 2,
            [noise] * 2,
            control=STRIDE * one,
            initial_std=[START_STD] * 2,
            missing=missing,
            max_steps=STEPS,
            batch_size=[count],
            seed=seed,
        )
        self.action_spec = Bounded(-1.0, 1.0, (count, 2))

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._step(tensordict)
        return out.set("reward", altitude(out["state"] + START).unsqueeze(-1))


def exact_filter(noise: float) -> KalmanFilter:
    """Returns the Kalman filter with the true model of the hike."""
    one = torch.eye(2)
    return KalmanFilter(
        one,
        one,
        process_noise=[PROCESS] * len(one),
        noise=[max(noise, 1e-3)] * 2,
        mean=torch.zeros(2),
        cov=START_STD**2 * one,
        control=STRIDE * one,
        update_at_reset=True,
    )


def unlearned_filter(members: int) -> DEnKF:
    """Returns a filter with known observation model and reset; the effect of actions and both noises are learned."""
    linear = nn.Linear(4, 2)
    nn.init.zeros_(linear.weight)
    nn.init.zeros_(linear.bias)
    q = m.ConstantNoise([0.1] * 2, trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return DEnKF(
        transition=m.LearnedTransition(linear, action_key="action"),
        sensor=None,
        observation=m.Select([0, 1]),
        noise=m.ConstantNoise([0.2] * 2, trainable=True, in_key="observation"),
        analysis=m.EnsembleAnalysis("etkf", observation_key="observation"),
        initial=m.GaussianPrior([0.0] * 2, [START_STD] * 2, ensemble_size=members),
        process_noise=q,
        update_at_reset=True,
    )
