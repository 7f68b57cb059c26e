"""Scores of sensors and beliefs that several studies use, and the cost of a filter."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble, crps_gaussian


def counted(out: TensorDict, dims: Sequence[int], floor: float) -> tuple[Tensor, Tensor, Tensor]:
    """Returns means and variances of a belief ``[*K, T]`` and the truth, ``[*K, T - 1, D]``: the first row is given.

    Args:
        out: with ``("belief", "mean")``, ``("belief", "var")`` and ``"state"``.
        dims: D dimensions of the state.
        floor: least variance: identical particles have zero variance, and no likelihood.
    """
    values = out["belief", "mean"], out["belief", "var"], out["state"]
    mean, variance, truth = (value[..., 1:, list(dims)] for value in values)
    return mean, variance.clamp_min(floor), truth


def belief_crps(out: TensorDict, dims: Sequence[int], unit: Tensor, floor: float) -> Tensor:
    """Returns the CRPS of beliefs, approximated by Gaussians, in units, ``[*K, T - 1, D]``."""
    return crps_gaussian(*counted(out, dims, floor)) / unit


@torch.no_grad()
def cost(model: Filter, run: Callable[[], object], steps: int) -> dict[str, float]:
    """Returns the number of parameters without the sensor, and milliseconds per step: the least of three runs."""
    parameters = {id(p): p.numel() for name, p in model.named_parameters() if not name.startswith("module.sensor.")}
    seconds = []
    for _ in range(3):
        begun = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - begun)
    return {"parameters": sum(parameters.values()), "ms_per_step": 1e3 * min(seconds) / steps}


@torch.no_grad()
def processor_ms(run: Callable[[], object], steps: int, runs: int = 10) -> float:
    """Returns processor milliseconds per step, which depend little on other jobs: the least of some warm runs."""
    run()
    seconds = []
    for _ in range(runs):
        begun = time.process_time()
        run()
        seconds.append(time.process_time() - begun)
    return 1e3 * min(seconds) / steps


class SensorLoss(nn.Module):
    """CRPS of a sensor's samples against the true reading, in units of a good sensor's errors.

    Args:
        sensor: reads frames.
        target: maps frames ``[N]`` to true readings ``[N, O]``.
        unit: ``[O]``.
        terms: dimensions of each loss, by name.
    """

    def __init__(
        self, sensor: nn.Module, target: Callable[[TensorDict], Tensor], unit: Tensor, terms: dict[str, slice]
    ):
        super().__init__()
        self.sensor, self.target, self.terms = sensor, target, terms
        self.register_buffer("unit", unit)

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """Scores the observed ones of frames ``[N]``."""
        score = crps_ensemble(self.sensor(frames)["sensor", "ensemble"], self.target(frames)) / self.unit
        if "observed" in frames:
            score = score[frames["observed"].squeeze(-1)]
        score = score.mean(0)
        return {name: score[dims].mean() for name, dims in self.terms.items()}
