"""The library's filters and smoothers on a system, all seeds as one batch."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.smoothing.cases import Case
from benchmarks.smoothing.systems import SYSTEMS, Cycle, frames_of, simulate
from torch_denkf.baselines import IEnKS
from torch_denkf.filters import DEnKF, Filter, ParticleFilter
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianLikelihood, GaussianPrior, Select
from torch_denkf.smoothers import EnRTS, FixedLag

BELIEF, SMOOTHED = ("belief", "mean"), ("smoothed", "mean")


def make_filter(case: Case) -> Filter:
    """Returns the filter of a case."""
    system = SYSTEMS[case.system]
    size = len(system.mean)
    parts = {
        "transition": Cycle(system),
        "sensor": None,
        "observation": Select(range(size)),
        "noise": ConstantNoise([system.noise**0.5] * size, in_key="reading"),
        "initial": GaussianPrior(system.mean, [system.variance**0.5] * size, ensemble_size=case.ensemble_size),
    }
    if case.method == "IEnKS":
        return IEnKS(**parts, inflation=case.inflation, rotate=True, observation_key="reading")
    if case.method == "particles":
        likelihood = GaussianLikelihood(observation_key="reading")
        return ParticleFilter(**parts, likelihood=likelihood, jitter=case.jitter, ess_threshold=case.ess_threshold)
    return DEnKF(**parts, analysis=EnsembleAnalysis(case.scheme, inflation=case.inflation, observation_key="reading"))


def estimates(case: Case, readings: Tensor) -> tuple[Tensor, Tensor]:
    """Returns means of all cycles, filtered and smoothed, ``[seeds, cycles, N]`` each.

    The smoothed means are those of the cycles with ``lag`` later ones.
    """
    torch.manual_seed(0)
    frames, filter = frames_of(readings), make_filter(case)
    if case.method == "EnRTS":
        out = EnRTS(filter, damping=case.damping).sequence(frames, keep=[BELIEF])
        return out[BELIEF][:, 1:], out[SMOOTHED][:, 1:]
    if case.method == "particles":
        out = filter.sequence(frames, keep=[BELIEF])
        return out[BELIEF][:, 1:], out[BELIEF][:, :0]
    lag = case.lag or 1
    running = filter if case.method == "IEnKS" else FixedLag(filter, lag)
    out = running.sequence(frames, keep=[BELIEF, SMOOTHED])  # the smoothed mean of a cycle is stored lag cycles later
    return out[BELIEF][:, 1:], out[SMOOTHED][:, 1 + lag :]


def rows(case: Case, seeds: Sequence[int], cycles: int) -> list[dict]:
    """Returns one row for each seed."""
    torch.set_default_dtype(torch.float64)
    system = SYSTEMS[case.system]
    path, readings = simulate(system, seeds, cycles)
    truth, burn_in = path[:, system.steps :: system.steps], system.counts_from(cycles)
    with torch.no_grad():
        filtered, smoothed = estimates(case, readings)

    def rmse(means: Tensor) -> list[float]:
        errors = (means - truth[:, : means.shape[1]]).square().mean(-1).sqrt()
        return errors[:, burn_in:].mean(-1).tolist()

    return [
        {**case.labels(), "seed": seed, "rmse_filter": of_filter, "rmse_smoother": of_smoother}
        for seed, of_filter, of_smoother in zip(seeds, rmse(filtered), rmse(smoothed), strict=True)
    ]
