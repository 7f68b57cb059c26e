"""Errors, coverage, spread and cost of trained filters on whole demos that nothing was trained on."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.data import UR5ExperienceReplay
from torch_denkf.filters import Filter
from torch_denkf.metrics import interval_coverage, state_errors
from torch_denkf.modules import ImageSensor
from benchmarks.ur5.demos import JOINTS, STATE
from benchmarks.ur5.readings import BLACK, CONDITIONS, blackouts, fail, read_all
from benchmarks.ur5.recipes import Recipe
from benchmarks.ur5.sensors import WRIST, Preset
from benchmarks.ur5.training import coverage, filter_error, run_filter

NAMES = ("filter", "sensor", "domain", "training", "condition", "ensemble_size", "seed")
SCORES = ("joint_mae_deg", "ee_mae_cm", "coverage90", *(f"J{i + 1}_deg" for i in range(JOINTS)))
BLACKOUT = ("blackout_joint_mae_deg", "std_before_deg", "std_blind_deg", "std_after_deg")
COLUMNS = (*NAMES, *SCORES, *BLACKOUT, "validation_crps", "parameters", "ms_per_step", "demos")
AFTER = 15  # steps after a blackout at which the spread is taken again


def errors(mean: Tensor, truth: Tensor) -> dict[str, float]:
    """Mean absolute errors of demos ``[N, T, 10]`` over all rows but the first, which is given.

    Joints: mean over J1..J7 in degrees, J6 and the others wrapped, J7 the gripper's opening as the angle it is stored
    as. Place: mean over the absolute errors of x, y and z, in cm.
    """
    mae = state_errors(mean[:, 1:].flatten(0, 1), truth[:, 1:].flatten(0, 1), angles=range(6)).mae
    joints = mae[:JOINTS].rad2deg()
    named = {f"J{number + 1}_deg": float(value) for number, value in enumerate(joints)}
    return {"joint_mae_deg": float(joints.mean()), "ee_mae_cm": 100 * float(mae[JOINTS:].mean()), **named}


def blackout(mean: Tensor, var: Tensor, truth: Tensor, begin: Tensor) -> dict[str, float]:
    """Error of the joints in the black frames, and their mean standard deviation before, at the end of, and after."""
    rows = torch.arange(len(mean))
    std = var[..., :JOINTS].clamp_min(0).sqrt().rad2deg().mean(-1)
    step = begin.unsqueeze(-1) + torch.arange(BLACK)
    step = step.clamp(max=mean.shape[1] - 1)
    error = state_errors(
        mean[rows.unsqueeze(-1), step].flatten(0, 1), truth[rows.unsqueeze(-1), step].flatten(0, 1), angles=range(6)
    )
    last, after = (begin + BLACK - 1, begin + BLACK + AFTER)
    at = [value.clamp(0, mean.shape[1] - 1) for value in (begin - 1, last, after)]
    values = [float(std[rows, index].mean()) for index in at]
    return dict(zip(BLACKOUT, (float(error.mae[:JOINTS].rad2deg().mean()), *values), strict=True))


def hold_last(values: Tensor, seen: Tensor, start: Tensor) -> Tensor:
    """Readings ``[N, T, S]`` where seen ``[N, T, 1]``, else the last one, or the start ``[N, S]``."""
    held, last = [], start
    for value, mask in zip(values.unbind(1), seen.unbind(1), strict=True):
        last = torch.where(mask, value, last)
        held.append(last)
    return torch.stack(held, 1)


def conditions_of(clean: TensorDict, salted: TensorDict) -> dict[str, TensorDict]:
    """Readings of the test demos in all conditions."""
    return {name: salted if name == "salt_and_pepper" else fail(clean, name) for name in CONDITIONS}


def sensor_rows(preset: Preset, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """The sensor alone. The right one of the two J6 is granted to it; where it sees nothing, its last reading stays."""
    rows = []
    for condition, reading in readings.items():
        truth, samples = reading["state"], reading["sensor", "ensemble"]
        near = truth[..., WRIST]
        read = preset.state_of(samples.mean(-2), near)
        members = preset.state_of(samples, near.unsqueeze(-1).expand(samples.shape[:-1]))
        seen = reading["observed"][:, 1:]
        held = hold_last(read, reading["observed"], truth[:, 0])
        at = seen.expand(*seen.shape[:2], JOINTS).reshape(-1, JOINTS)[:, 0]
        parts = (read, members.var(-2), truth)
        mean, var, true = (value[:, 1:, :JOINTS].reshape(-1, JOINTS)[at] for value in parts)
        covered = interval_coverage(mean, var.clamp_min(1e-12), true, level=0.9)
        row = {**names, "filter": "sensor", "condition": condition, "ensemble_size": samples.shape[-2]}
        rows.append({**row, **errors(held, truth), "coverage90": float(covered.mean()), "demos": len(truth)})
    return rows


def filter_rows(recipe: Recipe, model: Filter, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """A filter in all conditions."""
    costs, rows = cost(recipe, model, readings["clean"]), []
    outs = run_filter(recipe, model, torch.cat(list(readings.values()))).split(len(readings["clean"]))
    for (condition, reading), out in zip(readings.items(), outs, strict=True):
        rows.append({**names, "condition": condition, **scores(out), **costs, "demos": len(out)})
        if condition == "black20":
            mean, var = out["belief", "mean"][..., :STATE], out["belief", "var"]
            rows[-1] |= blackout(mean, var, out["state"], blackouts(*reading.shape))
    return rows


def scores(out: TensorDict) -> dict[str, float]:
    """Errors and coverage of beliefs ``[N, T]``."""
    return {**errors(out["belief", "mean"][..., :STATE], out["state"]), "coverage90": float(coverage(out).mean())}


@torch.no_grad()
def cost(recipe: Recipe, model: Filter, readings: TensorDict, steps: int = 100) -> dict[str, float]:
    """Parameters behind the sensor, and milliseconds a step of one demo there, one thread: the least of three runs."""
    parameters = {id(p): p.numel() for name, p in model.named_parameters() if not name.startswith("module.sensor.")}
    seconds, row = [], readings[:1, :steps]
    for _ in range(3):
        begun = time.perf_counter()
        run_filter(recipe, model, row)
        seconds.append(time.perf_counter() - begun)
    return {"parameters": sum(parameters.values()), "ms_per_step": 1e3 * min(seconds) / row.shape[1]}


def size_rows(
    make,
    sensor: ImageSensor,
    codes: TensorDict,
    sizes: Sequence[int],
    weights: dict,
    inflation: float,
    names: dict,
    validation: TensorDict,
) -> list[dict]:
    """A trained ensemble filter with other numbers of members, on clean demos; ``make(size)`` is its recipe.

    Rows also have the CRPS on ``validation``, features of other demos, by which a size may be chosen.
    """
    rows = []
    for size in sizes:
        recipe = make(size)
        model = recipe.build()
        model.load_state_dict(weights)
        recipe.set_inflation(model, inflation)
        parts, first = [], None
        for part in codes.split(8):  # a large ensemble of all demos takes gigabytes
            readings = read_all(sensor, part, size)
            first = readings if first is None else first
            parts.append(run_filter(recipe, model, readings).exclude(("belief", "ensemble")))
        out = torch.cat(parts)
        row = {**names, "condition": "clean", "ensemble_size": size, "demos": len(out)}
        crps = validation_crps(recipe, model, read_all(sensor, validation, size))
        rows.append({**row, **scores(out), **cost(recipe, model, first), "validation_crps": crps})
    return rows


def validation_crps(recipe: Recipe, model: Filter, readings: TensorDict) -> float:
    """CRPS of a filter on clean demos and on the same with missing frames, in the units of the loss."""
    return filter_error(recipe, model, [readings, fail(readings, "missing", seed=1)])["crps"]


def save_beliefs(
    recipe: Recipe,
    model: Filter,
    readings: dict[str, TensorDict],
    data: UR5ExperienceReplay,
    demos: Sequence[int],
    folder: Path,
    name: str,
    conditions: Sequence[str] = ("clean", "black20"),
) -> None:
    """Leaves beliefs and pictures of the first test demos for the plots: ``NAME-CONDITION-DEMO.npz``."""
    folder.mkdir(parents=True, exist_ok=True)
    for condition in conditions:
        out = run_filter(recipe, model, readings[condition][: len(demos)])
        for row, number in zip(out, demos, strict=True):
            episode = next(e for e in data.episodes if e.demo == number)
            pixels = data[torch.arange(episode.start, episode.start + episode.length)]["pixels"]
            pixels = (pixels * row["observed"][..., None, None] * 255).round().to(torch.uint8)
            ensemble = row.get(("belief", "ensemble"), row["belief", "mean"].unsqueeze(-2))
            np.savez_compressed(
                folder / f"{name}-{condition}-{number}.npz",
                pixels=pixels.permute(0, 2, 3, 1).numpy(),
                truth=row["state"].numpy(),
                mean=row["belief", "mean"][:, :STATE].numpy(),
                var=row["belief", "var"][:, :STATE].numpy(),
                ensemble=ensemble[..., :STATE].numpy(),
                observed=row["observed"].squeeze(-1).numpy(),
            )
