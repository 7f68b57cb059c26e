"""The work that all candidates share: Table I without the image sensor, S = 5, O = 2, E = 32, drop rate 26/256.

Transition (5, 32, 32, 64, 64, 5) with dropout, residual; observation (5, 32, 32, 64, 64, 2); noise of the observation
(2, 16, 16, 2); ReLU everywhere; the sensor's samples are given. One set of weights, handed to every peer as numpy.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.filters import DEnKF
from torch_denkf.modules import (
    DiagonalNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedObservation,
    LearnedTransition,
    StochasticMLP,
)

STATE, OBSERVATION, MEMBERS = 5, 2, 32
HIDDEN, NOISE_HIDDEN = (32, 32, 64, 64), (16, 16)
RATE = 26 / 256  # 0.1, as a byte has it
STD = 0.5  # of the observation noise before training
STEPS = 20  # of a sequence


def make_filter(scheme: str = "sensor") -> DEnKF:
    """The filter, with fixed weights; its gain is small enough that long sequences stay bounded.

    Args:
        scheme: ``"sensor"`` reads samples ``("sensor", "ensemble")``; ``"perturbed"`` one reading a frame, of the
            same name, ``[*B, O]``.
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


def make_frames(batch: int, steps: int = STEPS, *, samples: bool = True) -> TensorDict:
    """Frames ``[batch, steps]`` with the sensor's samples, or one reading each."""
    generator = torch.Generator().manual_seed(1)
    shape = (batch, steps, MEMBERS, OBSERVATION) if samples else (batch, steps, OBSERVATION)
    return TensorDict({("sensor", "ensemble"): torch.randn(shape, generator=generator)}, [batch, steps])


def start(filter: DEnKF, batch: int) -> Tensor:
    """An ensemble to start from, ``[batch, E, S]``."""
    torch.manual_seed(2)
    return filter.initial(TensorDict({}, [batch])).get(("belief", "ensemble"))


def weights(filter: DEnKF) -> dict[str, list[tuple[np.ndarray, np.ndarray]]]:
    """Weight ``[out, in]`` and bias of every layer of the three networks."""
    networks = {name: filter[name].module for name in ("transition", "observation", "noise")}
    return {
        name: [(layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy()) for layer in network.layers]
        for name, network in networks.items()
    }


def noise_floor(filter: DEnKF) -> tuple[np.ndarray, np.ndarray]:
    """r^2 - c and c of the noise model, ``[O]`` each."""
    return filter["noise"].variance.numpy().copy(), filter["noise"].floor.numpy().copy()


def operations(batch: int) -> int:
    """Floating-point operations of a step that cannot be avoided: products of matrices, and the masks' factors."""

    def network(sizes: tuple[int, ...]) -> int:
        return sum(2 * rows * columns for rows, columns in pairwise(sizes))

    members = network((STATE, *HIDDEN, STATE)) + network((STATE, *HIDDEN, OBSERVATION)) + sum(HIDDEN)
    members += 2 * OBSERVATION * (OBSERVATION + STATE) + 2 * OBSERVATION * STATE  # covariances; gain times shift
    frame = network((OBSERVATION, *NOISE_HIDDEN, OBSERVATION)) + OBSERVATION**3
    return batch * (MEMBERS * members + frame)


def traffic(filter: DEnKF, batch: int) -> int:
    """Bytes that a step must move: weights once, ensemble in and out, samples in, a byte a mask bit's draw."""
    ensemble = batch * MEMBERS * (2 * STATE + OBSERVATION) * 4
    return ensemble + batch * MEMBERS * sum(HIDDEN) + sum(p.numel() * 4 for p in filter.parameters())
