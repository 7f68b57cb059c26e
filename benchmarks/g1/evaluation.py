"""Errors, coverage, spread and cost of filters and baselines on test episodes, which nothing was trained on."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.scores import cost
from benchmarks.g1.baselines import Baselines
from benchmarks.g1.readings import blackouts
from benchmarks.g1.recipes import G1Recipe
from benchmarks.g1.scores import blackout, scores
from benchmarks.g1.tables import named
from benchmarks.g1.targets import Target
from benchmarks.g1.training import run_filter
from torch_denkf._files import write_bytes
from torch_denkf.filters import Filter

TIMED = 100  # rows to time a filter on


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
    for condition, reading in readings.items():
        mean, var = run_filter(model, reading)
        scored = score_row(recipe.target, mean[..., :size], var[..., :size], reading, condition)
        rows.append({**names, **scored, **own})
    return rows


def save_beliefs(
    recipe: G1Recipe, model: Filter, readings: dict[str, TensorDict], numbers: list[int], file: Path, *, count: int = 2
) -> None:
    """Leaves beliefs of the first test episodes for the pictures, clean and with black frames: ``FILE.npz``."""
    size, entries = recipe.target.size, {"episodes": np.array(numbers[:count])}
    for condition in ("clean", "black20", "black20_unannounced"):
        reading = readings[condition][:count]
        mean, var = run_filter(model, reading)
        begin = blackouts(readings[condition]["valid"].sum((1, 2)))[:count]
        parts = {
            "mean": mean[..., :size],
            "var": var[..., :size],
            "truth": reading["state"],
            "observed": reading["observed"].squeeze(-1),
            "length": reading["valid"].sum((1, 2)),
            "begin": begin,
            "reading": reading["sensor", "ensemble"].mean(-2),
        }
        entries |= {f"{condition}_{name}": value.numpy() for name, value in parts.items()}
    memory = io.BytesIO()
    np.savez_compressed(memory, **entries)
    write_bytes(file, memory.getbuffer())
