"""The stages of a filter on readings of the frozen sensor; then its one number."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.training import fit_filter
from benchmarks.g1.readings import Windows
from benchmarks.g1.recipes import G1Recipe
from benchmarks.g1.recordings import JOINTS
from benchmarks.g1.scores import FLOOR, counted, scores
from torch_denkf.filters import Filter
from torch_denkf.metrics import interval_coverage
from torch_denkf.training import Stage

INFLATIONS = (0.7, 0.85, 1.0, 1.2, 1.45, 1.75, 2.1)


@dataclass(frozen=True)
class FilterBudget:
    """Updates of each stage; the filter's windows."""

    motion: int = 1500  # updates of the motion on true states
    filter: int = 45  # updates of a filter on readings
    length: int = 64  # rows of the filter's windows
    batch: int = 8  # windows an update


@torch.no_grad()
def run_filter(model: Filter, readings: TensorDict) -> tuple[Tensor, Tensor]:
    """Means and variances ``[N, T, S]`` of a filter, from where episodes begin on average."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        out = model.sequence(readings.exclude("motion", "valid", "state", "arrived").copy())  # nested entries, too
    return out["belief", "mean"], out["belief", "var"]


def filter_error(model: Filter, readings: TensorDict) -> dict[str, float]:
    """Scores of a filter."""
    mean, var = run_filter(model, readings)
    named = scores(mean[..., :JOINTS], var[..., :JOINTS], readings)
    return {key: named[key] for key in ("crps", "joint_mae_deg", "coverage90")}


def filter_coverage(model: Filter, readings: TensorDict) -> Tensor:
    """Share of the truth inside the belief's 90 % intervals."""
    mean, var = run_filter(model, readings)
    at = counted(readings)
    mean, var = mean[..., :JOINTS][at], var[..., :JOINTS][at].clamp_min(FLOOR)
    return interval_coverage(mean, var, readings["state"][at], level=0.9).mean()


def train_filter(
    recipe: G1Recipe,
    windows: Windows,
    validation: TensorDict,
    *,
    out: Path,
    seed: int,
    budget: FilterBudget,
) -> Filter:
    """Trains one filter, or goes on where it was broken off.

    Args:
        recipe: of the filter.
        windows: of the tuning episodes, which the sensor has not seen.
        validation: readings ``[N, T]`` to choose by, in all conditions.
        out: checkpoints and logs.
        seed: of all random numbers.
        budget: updates.

    Returns:
        The model, on its best parameters, with its inflation.
    """
    torch.manual_seed(seed)
    model = recipe.build()
    padding, updates = recipe.size - 2 * JOINTS, budget.filter * recipe.longer

    def stages() -> list[Stage]:
        return [
            Stage(
                "filter",
                recipe.loss(recipe.for_training(model)),
                lambda generator, _: windows.sample(generator, budget.batch, recipe.error, padding),
                updates,
                lr=2e-3,
                validate=lambda: filter_error(model, validation),
            )
        ]

    fit_filter(
        recipe,
        model,
        stages,
        lambda: filter_coverage(model, validation),
        out=out,
        inflations=INFLATIONS,
        seed=seed,
        device="cpu",
        monitor="crps",
        validate_every=max(updates // 3, 1),
        save_every=100,
    )
    return model
