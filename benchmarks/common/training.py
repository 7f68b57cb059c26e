"""Trains a filter in stages, and then chooses its inflation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.recipes import Recipe
from torch_denkf.filters import Filter
from torch_denkf.training import FilterTrainer, Stage, choose
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint


def coverage_error(coverage: Tensor) -> float:
    """Returns the distance of the coverage of 90 % intervals from 90 %, summed over its components."""
    return float((coverage - 0.9).abs().sum())


def fit_filter(
    recipe: Recipe,
    model: Filter,
    stages: Callable[[], Sequence[Stage]],
    coverage: Callable[[], Tensor] | None,
    *,
    out: Path,
    inflations: Sequence[float],
    error: Callable[[], float] | None = None,
    notes: dict | None = None,
    **settings,
) -> None:
    """Trains a filter, then chooses its inflation; loads both from ``out/filter.pt`` if the file exists.

    Args:
        recipe: the model's.
        model: trained in place; it ends with its best parameters.
        stages: makes the stages.
        coverage: of the model's 90 % intervals on validation data, by which the inflation is chosen.
        out: folder for checkpoints and logs.
        inflations: to choose from.
        error: of the model on validation data; if given, the inflation is chosen by it instead of the coverage.
        notes: plain values and tensors to save in the file, too.
        **settings: of :class:`~torch_denkf.training.FilterTrainer`.
    """
    file = out / "filter.pt"
    if file.exists():
        read_filter(recipe, model, read_checkpoint(file))
        return
    trainer = FilterTrainer(model, stages(), out=out, **settings)
    trainer.fit()

    def apply(factor: float) -> None:
        recipe.set_inflation(model, factor)

    if error is not None:
        inflation = choose(inflations, apply, error)
    elif coverage is not None:
        inflation = choose(inflations, apply, lambda: coverage_error(coverage()))
    else:
        raise TypeError("fit_filter chooses the inflation by coverage or by error; pass one of them")
    if trainer.processes.is_main:
        write_checkpoint(file, {"model": model.state_dict(), "inflation": inflation, **(notes or {})})


def read_filter(recipe: Recipe, model: Filter, saved: dict) -> Filter:
    """Returns the model with the parameters and the inflation of a ``filter.pt``."""
    model.load_state_dict(saved["model"])
    recipe.set_inflation(model, saved["inflation"])
    return model


def random_rows(rows: TensorDict, batch: int) -> Callable[[torch.Generator, int | None], TensorDict]:
    """Returns a stage's ``sample``, which draws ``batch`` of the rows ``[N]``."""
    return lambda generator, length: rows[torch.randint(len(rows), (batch,), generator=generator)]
