"""Errors, coverage, spread and cost of filters and baselines on test episodes, which nothing was trained on."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.beliefs import save_belief
from benchmarks.common.scores import cost
from benchmarks.g1.baselines import Baselines
from benchmarks.g1.readings import BLACK, blackouts
from benchmarks.g1.recipes import G1Recipe
from benchmarks.g1.scores import blackout, scores
from benchmarks.g1.tables import named
from benchmarks.g1.targets import Target
from benchmarks.g1.training import run_filter
from torch_denkf.filters import Filter

TIMED = 100  # rows to time a filter on
PICTURED = 2  # test episodes whose beliefs are left for the plots


def score_row(
    target: Target, mean: Tensor, var: Tensor, readings: TensorDict, condition: str
) -> dict[str, float | str]:
    """One row's scores."""
    row = {"condition": condition, **named(scores(target, mean, var, readings)), "episodes": len(readings)}
    if condition.startswith("black20"):
        begin = blackouts(readings["valid"].sum((1, 2)))
        row |= blackout(target, mean, var, readings, begin)
    return row


def baseline_rows(baselines: Baselines, target: Target, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """All baselines in all conditions."""
    rows = []
    for name in baselines.names:
        for condition, reading in readings.items():
            mean, var = baselines(name, reading)
            rows.append({**names, "filter": name, **score_row(target, mean, var, reading, condition)})
    return rows


def filter_rows(recipe: G1Recipe, model: Filter, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """A filter in all conditions."""
    row = readings["clean"][:1, :TIMED]
    own, rows, size = cost(model, lambda: run_filter(model, row), row.shape[1]), [], recipe.target.size
    means, variances = run_filter(model, torch.cat(list(readings.values())))
    parts = (one.split(len(readings["clean"])) for one in (means, variances))
    for (condition, reading), mean, var in zip(readings.items(), *parts, strict=True):
        scored = score_row(recipe.target, mean[..., :size], var[..., :size], reading, condition)
        rows.append({**names, **scored, **own})
    return rows


def save_beliefs(
    recipe: G1Recipe, model: Filter, readings: dict[str, TensorDict], numbers: list[int], name: str, folder: Path
) -> None:
    """Leaves beliefs of the first test episodes for the pictures: ``NAME-CONDITION-EPISODE.pt``."""
    size = recipe.target.size
    for condition in ("clean", "black20", "black20_unannounced"):
        everyone = readings[condition]
        lengths = everyone["valid"].sum((1, 2))
        starts = blackouts(lengths)
        means, variances = run_filter(model, everyone[:PICTURED])
        for k, reading in enumerate(everyone[:PICTURED]):
            step, rows = torch.arange(int(lengths[k])), slice(int(lengths[k]))
            black = (step >= starts[k]) & (step < starts[k] + BLACK) & (condition != "clean")
            mean, var = means[k, rows, :size], variances[k, rows, :size]
            read = {"reading": reading["sensor", "ensemble"][rows].mean(-2)}
            file = folder / f"{name}-{condition}-{numbers[k]}.pt"
            save_belief(file, mean, var, reading["state"][rows], ~black.unsqueeze(-1), **read)
