"""The workload of all candidates: Table I without the image sensor, S = 5, O = 2, E = 32, drop rate 26/256.

Transition (5, 32, 32, 64, 64, 5) with dropout, residual; observation (5, 32, 32, 64, 64, 2); noise of the observation
(2, 16, 16, 2); ReLU everywhere; the sensor's samples are given. All peers get the same weights as numpy arrays.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.filters import EKF, UKF, DEnKF
from torch_denkf.filters.base import Filter
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    DiagonalNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    MomentPrior,
    Select,
    StochasticMLP,
    SubModel,
)

STATE, OBSERVATION, MEMBERS = 5, 2, 32
HIDDEN, NOISE_HIDDEN = (32, 32, 64, 64), (16, 16)
RATE = 26 / 256  # 0.1, rounded to a multiple of 1 / 256
STD = 0.5  # of the observation noise before training
PROCESS_STD = 0.1  # of the process noise of filters with a mean and a covariance
POINTS = {"alpha": 1.0, "beta": 0.0, "kappa": 0.5}  # of the unscented transform
STEPS = 20  # of a sequence


def make_filter(scheme: str = "sensor") -> DEnKF:
    """Returns the filter, with fixed weights; its gain is small enough that long sequences stay bounded.

    Args:
        scheme: ``"sensor"`` reads samples ``("sensor", "ensemble")``; ``"perturbed"`` one reading per frame under the
            same key, ``[*B, O]``.
    """
    torch.manual_seed(0)
    return DEnKF(
        LearnedTransition(StochasticMLP(STATE, STATE, HIDDEN, rate=RATE, output_gain=0.3)),
        None,
        LearnedObservation(StochasticMLP(STATE, OBSERVATION, HIDDEN, layer="none")),
        DiagonalNoise(OBSERVATION, r=STD, num_cells=NOISE_HIDDEN),
        EnsembleAnalysis(scheme),
        initial=GaussianPrior(torch.zeros(STATE), torch.ones(STATE), ensemble_size=MEMBERS),
    )


def car_filter(sensor: Callable[[], SubModel]) -> DEnKF:
    """Returns the README's filter of a vehicle: state [x, y, theta, v, theta_dot], Table I's networks and noise."""
    return DEnKF(
        transition=UnicycleTransition(velocity=StochasticMLP(2, 2), dt=0.103),
        sensor=sensor(),
        observation=Select([3, 4]),
        noise=DiagonalNoise(observation_dim=2),
        analysis=EnsembleAnalysis("sensor"),
        initial=AroundState([0.0, 0.0, 0.0, 0.3, 0.02]),
    )


def make_gaussian_filter(kind: str) -> EKF | UKF:
    """Returns a filter with a mean and a covariance on the same networks, without dropout, and constant Q and R.

    Its first belief is N(0, I), which its first reading updates.

    Args:
        kind: ``"EKF"`` or ``"UKF"``.
    """
    torch.manual_seed(0)
    noise = ConstantNoise([PROCESS_STD] * STATE, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    models = (
        LearnedTransition(StochasticMLP(STATE, STATE, HIDDEN, layer="none", output_gain=0.3)),
        None,
        LearnedObservation(StochasticMLP(STATE, OBSERVATION, HIDDEN, layer="none")),
        ConstantNoise([STD] * OBSERVATION),
    )
    start = {
        "process_noise": noise,
        "initial": MomentPrior(torch.zeros(STATE), torch.eye(STATE)),
        "update_at_reset": True,
        "observation_key": ("sensor", "ensemble"),
    }
    return EKF(*models, **start) if kind == "EKF" else UKF(*models, **POINTS, **start)


def make_frames(batch: int, steps: int = STEPS, *, samples: bool = True) -> TensorDict:
    """Returns frames ``[batch, steps]`` with the sensor's samples, or one reading each."""
    generator = torch.Generator().manual_seed(1)
    shape = (batch, steps, MEMBERS, OBSERVATION) if samples else (batch, steps, OBSERVATION)
    return TensorDict({("sensor", "ensemble"): torch.randn(shape, generator=generator)}, [batch, steps])


def start(filter: DEnKF, batch: int) -> Tensor:
    """Returns an initial ensemble, ``[batch, E, S]``."""
    torch.manual_seed(2)
    return filter.initial(TensorDict({}, [batch])).get(("belief", "ensemble"))


def weights(filter: Filter) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Returns weight ``[out, in]`` and bias of every layer of the networks: three, or two for constant Q and R."""
    if isinstance(filter, DEnKF):
        networks = {name: filter[name].module for name in ("transition", "observation", "noise")}
    else:  # one module inside the other: the filter's step, the model, its network
        networks = {"transition": filter["transition"].module.module, "observation": filter["analysis"].module.module}
    return {
        name: [(layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()) for layer in network.layers]
        for name, network in networks.items()
    }


def noise_floor(filter: DEnKF) -> tuple[np.ndarray, np.ndarray]:
    """Returns r^2 - c and c of the noise model, ``[O]`` each."""
    return filter["noise"].variance.numpy().copy(), filter["noise"].floor.numpy().copy()
