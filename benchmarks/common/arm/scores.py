"""Runs filters of arms on whole sequences, scores their beliefs, and trains them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arm import JOINTS
from benchmarks.common.arm.beliefs import save_belief
from benchmarks.common.arm.readings import BLACK, Windows, blackouts
from benchmarks.common.arm.recipes import ArmRecipe
from benchmarks.common.scores import cost
from benchmarks.common.training import fit_filter
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_gaussian
from torch_denkf.functional.manifolds import Flat
from torch_denkf.metrics import interval_coverage, state_errors
from torch_denkf.training import Stage

FLOOR = 1e-10  # least variance: identical particles have zero variance, and no likelihood
AFTER = 15  # rows after a blackout at which the spread is measured again
TIMED = 100  # rows to time a filter on
PICTURED = 3  # sequences whose beliefs are saved for the plots
READ = ("state", "motion", "valid", "arrived")  # entries that only the scores read


@torch.no_grad()
def run_filter(recipe: ArmRecipe, model: Filter, readings: TensorDict, chunk: int = 128) -> TensorDict:
    """Returns the readings ``[N, T]`` with the belief's mean and variances of the components that the sensor reads."""
    behind, beliefs = recipe.behind(model), []
    hidden = [key for key in READ if key != recipe.first_key]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for part in readings.split(chunk):
            belief = behind.sequence(part.exclude(*hidden).copy())["belief"]  # nested entries, too
            beliefs.append(belief.select("mean", "var").apply(lambda value: value[..., : recipe.motion.read]))
    return readings.copy().set("belief", torch.cat(beliefs))


def estimated(readings: TensorDict, mean: Tensor, var: Tensor) -> TensorDict:
    """Returns the readings ``[N, T]`` with an estimate ``[N, T, D]`` from elsewhere as their belief."""
    return readings.copy().set("belief", TensorDict({"mean": mean, "var": var}, readings.shape))


def counted(out: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
    """Returns means, variances and truth ``[M, D]`` of all rows but a sequence's first, which is given."""
    at = out["valid"].squeeze(-1).clone()
    at[:, 0] = False
    return out["belief", "mean"][at], out["belief", "var"][at].clamp_min(FLOOR), out["state"][at]


def coverage(out: TensorDict) -> Tensor:
    """Returns the share of the true joints inside the belief's 90 % intervals."""
    return interval_coverage(*(value[:, :JOINTS] for value in counted(out)), level=0.9).mean()


def absolute_errors(mean: Tensor, truth: Tensor, circular: Sequence[int]) -> Tensor:
    """Returns mean absolute errors ``[D]``: of the joints in degrees, then of a position in cm; some joints wrap."""
    error = state_errors(mean, truth, space=Flat(mean.shape[-1], circular=circular)).mae
    return torch.cat([error[:JOINTS].rad2deg(), 100 * error[JOINTS:]])


def scores(out: TensorDict, names: Sequence[str], unit: Tensor, circular: Sequence[int] = ()) -> dict[str, float]:
    """Returns errors, CRPS and coverage of beliefs ``[N, T]``, approximated by Gaussians.

    Args:
        out: of :func:`run_filter`.
        names: of the joints.
        unit: of the CRPS, ``[D]``.
        circular: joints that wrap.
    """
    mean, var, truth = counted(out)
    error = absolute_errors(mean, truth, circular)
    found = {f"{name}_deg": float(value) for name, value in zip(names, error[:JOINTS], strict=True)}
    found |= {"joint_mae_deg": float(error[:JOINTS].mean()), "coverage90": float(coverage(out))}
    if len(error) > JOINTS:
        found["ee_mae_cm"] = float(error[JOINTS:].mean())
    return {**found, "crps": float((crps_gaussian(mean, var, truth) / unit).mean())}


def blackout(out: TensorDict, circular: Sequence[int] = ()) -> dict[str, float]:
    """Returns the joint error in black frames, and the mean standard deviation before, at the end and after."""
    begin, steps, rows = blackouts(out["valid"].sum((1, 2))), out.shape[1] - 1, torch.arange(len(out))
    at = rows.unsqueeze(-1), (begin.unsqueeze(-1) + torch.arange(BLACK)).clamp(max=steps)
    error = absolute_errors(out["belief", "mean"][at].flatten(0, 1), out["state"][at].flatten(0, 1), circular)
    std = out["belief", "var"][..., :JOINTS].clamp_min(0).sqrt().mean(-1).rad2deg()
    times = {"before": begin - 1, "blind": begin + BLACK - 1, "after": begin + BLACK + AFTER}
    spread = {f"std_{name}_deg": float(std[rows, time.clamp(0, steps)].mean()) for name, time in times.items()}
    return {"blackout_joint_mae_deg": float(error[:JOINTS].mean()), **spread}


def score_row(out: TensorDict, condition: str, names: Sequence[str], unit: Tensor, circular=()) -> dict:
    """Returns a row of one condition."""
    row = {"condition": condition, **scores(out, names, unit, circular), "episodes": len(out)}
    return row | (blackout(out, circular) if condition == "black20" else {})


def filter_rows(recipe: ArmRecipe, model: Filter, readings: dict[str, TensorDict], row: Callable[..., dict]) -> list:
    """Returns rows of a filter in all conditions; ``row`` maps a belief and the condition's name to one."""
    costs = cost_of(recipe, model, readings["clean"])
    outs = run_filter(recipe, model, torch.cat(list(readings.values()))).split(len(readings["clean"]))
    return [{**row(out, condition), **costs} for condition, out in zip(readings, outs, strict=True)]


def cost_of(recipe: ArmRecipe, model: Filter, readings: TensorDict) -> dict[str, float]:
    """Returns the number of parameters without the sensor, and milliseconds per step of one sequence without it."""
    row = readings[:1, :TIMED]
    return cost(model, lambda: run_filter(recipe, model, row), row.shape[1])


def save_beliefs(recipe: ArmRecipe, model: Filter, readings: dict[str, TensorDict], name: str, folder: Path) -> None:
    """Saves beliefs of the first test sequences for the plots: ``NAME-CONDITION-NUMBER.pt``."""
    for condition in ("clean", "black20"):
        for number, out in enumerate(run_filter(recipe, model, readings[condition][:PICTURED])):
            out = out[: int(out["valid"].sum())]
            read = out["sensor", "ensemble"].mean(-2)
            reading = {"reading": read} if read.shape == out["state"].shape else {}
            belief = out["belief", "mean"], out["belief", "var"]
            file = folder / f"{name}-{condition}-{number}.pt"
            save_belief(file, *belief, out["state"], out["arrived"], **reading)


def filter_stage(
    recipe: ArmRecipe, model: Filter, windows: Windows, validation: TensorDict, updates: int, batch: int, lr: float
) -> Stage:
    """Returns a filter's training on windows of readings, validated on whole sequences by their CRPS."""
    return Stage(
        "filter",
        recipe.loss(recipe.behind(model, training=True)),
        lambda generator, _: recipe.begun(windows.sample(generator, batch), generator),
        updates,
        lr=lr,
        validate=lambda: filter_error(recipe, model, validation),
    )


def filter_error(recipe: ArmRecipe, model: Filter, readings: TensorDict) -> dict[str, float]:
    """Returns the CRPS of the belief in the units of the loss."""
    mean, var, truth = counted(run_filter(recipe, model, readings))
    return {"crps": float((crps_gaussian(mean, var, truth) / recipe.unit).mean())}


def fit(
    recipe: ArmRecipe,
    model: Filter,
    stages: Callable[[], list[Stage]],
    validation: Callable[[], TensorDict],
    *,
    inflations: Sequence[float],
    every: int,
    **settings,
) -> Filter:
    """Trains a filter, or resumes, then chooses its inflation by coverage; validates after ``every`` updates."""
    fit_filter(
        recipe,
        model,
        stages,
        lambda: coverage(run_filter(recipe, model, validation())),
        inflations=inflations,
        device="cpu",
        monitor="crps",
        validate_every=max(every, 1),
        save_every=100,
        **settings,
    )
    return model
