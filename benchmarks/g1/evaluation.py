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
from benchmarks.g1.recordings import JOINTS
from benchmarks.g1.scores import blackout, scores
from benchmarks.g1.training import run_filter
from torch_denkf.filters import Filter

TIMED = 100  # rows to time a filter on
PICTURED = 2  # test episodes whose beliefs are left for the plots


def score_row(mean: Tensor, var: Tensor, readings: TensorDict, condition: str) -> dict[str, float | str]:
    """One row's scores."""
    row = {"condition": condition, **scores(mean, var, readings), "episodes": len(readings)}
    if condition.startswith("black20"):
        row |= blackout(mean, var, readings, blackouts(readings["valid"].sum((1, 2))))
    return row


def baseline_rows(baselines: Baselines, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """All baselines in all conditions."""
    return [
        {**names, "filter": name, **score_row(*baselines(name, reading), reading, condition)}
        for name in baselines.names
        for condition, reading in readings.items()
    ]


def filter_rows(model: Filter, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """A filter in all conditions."""
    row = readings["clean"][:1, :TIMED]
    own, rows = cost(model, lambda: run_filter(model, row), row.shape[1]), []
    means, variances = run_filter(model, torch.cat(list(readings.values())))
    parts = (one[..., :JOINTS].split(len(readings["clean"])) for one in (means, variances))
    for (condition, reading), mean, var in zip(readings.items(), *parts, strict=True):
        rows.append({**names, **score_row(mean, var, reading, condition), **own})
    return rows


def save_beliefs(model: Filter, readings: dict[str, TensorDict], numbers: list[int], name: str, folder: Path) -> None:
    """Leaves beliefs of the first test episodes for the pictures: ``NAME-CONDITION-EPISODE.pt``."""
    for condition in ("clean", "black20", "black20_unannounced"):
        everyone = readings[condition]
        lengths = everyone["valid"].sum((1, 2))
        starts = blackouts(lengths)
        means, variances = run_filter(model, everyone[:PICTURED])
        for k, reading in enumerate(everyone[:PICTURED]):
            step, rows = torch.arange(int(lengths[k])), slice(int(lengths[k]))
            black = (step >= starts[k]) & (step < starts[k] + BLACK) & (condition != "clean")
            mean, var = means[k, rows, :JOINTS], variances[k, rows, :JOINTS]
            read = {"reading": reading["sensor", "ensemble"][rows].mean(-2)}
            file = folder / f"{name}-{condition}-{numbers[k]}.pt"
            save_belief(file, mean, var, reading["state"][rows], ~black.unsqueeze(-1), **read)
