"""Errors, coverage, spread and cost of trained filters on whole demos that nothing was trained on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.beliefs import save_belief
from benchmarks.common.scores import cost, processor_ms
from benchmarks.common.training import read_filter
from benchmarks.ur5.demos import JOINTS, STATE
from benchmarks.ur5.readings import BLACK, CONDITIONS, blackouts, fail, read_all, with_missing
from benchmarks.ur5.recipes import UR5Recipe
from benchmarks.ur5.sensors import WRIST, Preset
from benchmarks.ur5.tables import BLACKOUT
from benchmarks.ur5.training import filter_error, joint_coverage, run_filter
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.filters import Filter
from torch_denkf.functional.manifolds import Flat
from torch_denkf.metrics import interval_coverage, state_errors
from torch_denkf.modules import ImageSensor
from torch_denkf.training import hold_last

TIMED = 100  # steps to time a filter on
SPACE = Flat(10, circular=range(6))  # all joints but the gripper's opening wrap
AFTER = 15  # steps after a blackout at which the spread is taken again


def errors(mean: Tensor, truth: Tensor) -> dict[str, float]:
    """Mean absolute errors of demos ``[N, T, 10]`` over all rows but the first, which is given.

    Joints: mean over J1..J7 in degrees, J6 and the others wrapped, J7 the gripper's opening as the angle it is stored
    as. Place: mean over the absolute errors of x, y and z, in cm.
    """
    mae = state_errors(mean[:, 1:].flatten(0, 1), truth[:, 1:].flatten(0, 1), space=SPACE).mae
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
        mean[rows.unsqueeze(-1), step].flatten(0, 1), truth[rows.unsqueeze(-1), step].flatten(0, 1), space=SPACE
    )
    last, after = (begin + BLACK - 1, begin + BLACK + AFTER)
    at = [value.clamp(0, mean.shape[1] - 1) for value in (begin - 1, last, after)]
    values = [float(std[rows, index].mean()) for index in at]
    return dict(zip(BLACKOUT, (float(error.mae[:JOINTS].rad2deg().mean()), *values), strict=True))


def conditions_of(clean: TensorDict, salted: TensorDict) -> dict[str, TensorDict]:
    """Readings of the test demos in all conditions."""
    return {name: salted if name == "salt_and_pepper" else fail(clean, name) for name in CONDITIONS}


def sensor_rows(preset: Preset, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """The sensor alone; where it sees nothing, its last reading stays."""
    rows = []
    for condition, reading in readings.items():
        truth, samples = reading["state"], reading["sensor", "ensemble"]
        near = preset.side_of(samples.mean(-2))
        near = near + 2 * torch.pi * ((truth[..., WRIST] - near) / (2 * torch.pi)).round()  # whole turns do not count
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


def filter_rows(recipe: UR5Recipe, model: Filter, readings: dict[str, TensorDict], names: dict) -> list[dict]:
    """A filter in all conditions."""
    own, rows = costs(recipe, model, readings["clean"]), []
    outs = run_filter(recipe, model, torch.cat(list(readings.values()))).split(len(readings["clean"]))
    for (condition, reading), out in zip(readings.items(), outs, strict=True):
        rows.append({**names, "condition": condition, **scores(out), **own, "demos": len(out)})
        if condition == "black20":
            mean, var = out["belief", "mean"][..., :STATE], out["belief", "var"]
            rows[-1] |= blackout(mean, var, out["state"], blackouts(*reading.shape))
    return rows


def scores(out: TensorDict) -> dict[str, float]:
    """Errors and coverage of beliefs ``[N, T]``."""
    return {**errors(out["belief", "mean"][..., :STATE], out["state"]), "coverage90": float(joint_coverage(out))}


def costs(recipe: UR5Recipe, model: Filter, readings: TensorDict) -> dict[str, float]:
    """Parameters behind the sensor, and milliseconds a step of one demo there."""
    row = readings[:1, :TIMED]
    return cost(model, lambda: run_filter(recipe, model, row), row.shape[1])


def size_rows(
    make,
    sensor: ImageSensor,
    codes: TensorDict,
    sizes: Sequence[int],
    saved: dict,
    names: dict,
    validation: TensorDict,
    *,
    chunk: int | None = None,
) -> list[dict]:
    """A trained filter with other numbers of members, on clean demos; ``make(size)`` is its recipe.

    Rows also have the CRPS on ``validation``, features of other demos, by which a size may be chosen. With ``chunk``
    ``ms_per_step`` is processor time of compiled chunks of so many steps, and ``eager_ms_per_step`` of eager steps.
    """
    rows = []
    for size in sizes:
        recipe = make(size)
        model = read_filter(recipe, recipe.build(), saved)
        parts, first = [], None
        for part in codes.split(8):  # a large ensemble of all demos takes gigabytes
            readings = read_all(sensor, part, size)
            first = readings if first is None else first
            parts.append(run_filter(recipe, model, readings).exclude(("belief", "ensemble")))
        out = torch.cat(parts)
        row = {**names, "condition": "clean", "ensemble_size": size, "demos": len(out)}
        crps = validation_crps(recipe, model, read_all(sensor, validation, size))
        times = costs(recipe, model, first) if chunk is None else processor_times(recipe, model, first, chunk)
        rows.append({**row, **scores(out), **times, "validation_crps": crps})
    return rows


def processor_times(recipe: UR5Recipe, model: Filter, readings: TensorDict, chunk: int) -> dict[str, float]:
    """Milliseconds of the processor a step of one demo, eager and compiled in chunks; 0 compiles nothing."""
    row, behind, times = readings[:1, :TIMED], recipe.behind(model), {}
    for column, steps in (("eager_ms_per_step", 0), ("ms_per_step", chunk)):
        behind.compile(chunk=steps)
        times[column] = processor_ms(lambda: behind.sequence(row.copy()), row.shape[1])
    return times


def validation_crps(recipe: UR5Recipe, model: Filter, readings: TensorDict) -> float:
    """CRPS of a filter on clean demos and on the same with missing frames, in the units of the loss."""
    return filter_error(recipe, model, with_missing(readings))["crps"]


def save_beliefs(
    recipe: UR5Recipe,
    model: Filter,
    readings: dict[str, TensorDict],
    data: UR5ExperienceReplay,
    demos: Sequence[int],
    folder: Path,
    name: str,
    conditions: Sequence[str] = ("clean", "black20"),
) -> None:
    """Leaves beliefs and pictures of the first test demos for the plots: ``NAME-CONDITION-DEMO.pt``."""
    for condition in conditions:
        out = run_filter(recipe, model, readings[condition][: len(demos)])
        for row, number in zip(out, demos, strict=True):
            episode = next(e for e in data.episodes if e.demo == number)
            pixels = data[torch.arange(episode.start, episode.start + episode.length)]["pixels"]
            pixels = (pixels * row["observed"][..., None, None] * 255).round().to(torch.uint8)
            mean, var = (row["belief", key][:, :STATE] for key in ("mean", "var"))
            file = folder / f"{name}-{condition}-{number}.pt"
            save_belief(file, mean, var, row["state"], row["observed"], pixels=pixels)
