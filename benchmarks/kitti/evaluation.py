"""Errors of a trained filter on the drive that was left out, compared with dead reckoning and its floor."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from statistics import fmean, pstdev

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.scores import cost, counted
from benchmarks.kitti.folds import VELOCITIES, Part
from benchmarks.kitti.readings import read_spans
from benchmarks.kitti.recipes import REACH, KITTIRecipe
from benchmarks.kitti.streams import DISTURBANCES, Stream
from benchmarks.kitti.training import FLOOR, run_filter
from torch_denkf.applications.car import dead_reckoning
from torch_denkf.applications.car.metrics.benchmark import kitti_pathlength_error
from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error
from torch_denkf.applications.car.metrics.odometry import kitti_endpoint_error
from torch_denkf.applications.car.odometry.streams import all_frames, lose_frames
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_gaussian
from torch_denkf.functional.gaussian import gaussian_log_prob
from torch_denkf.metrics import interval_coverage, nees, spread_skill_ratio, state_errors
from torch_denkf.training import hold_last

MASKS = 8  # draws of the missing frames, over which the errors are averaged
WINDOWS = (50, 100, 200, 400, 800)  # steps; drives shorter than 50 steps have one window, the whole drive
TIMED = 100  # steps to time a filter on
DRAWS = 3  # runs of a filter with random draws, over which its errors are averaged


def last_velocities(reading: TensorDict, dt: float) -> Tensor:
    """Returns the sensor's mean velocities ``[N, 2]`` with a zero-order hold, which starts from the true ones.

    A pair over a gap gives the mean over its steps, unless its distance is beyond the sensor's reach.
    """
    steps = reading["steps"]

    def near(row: int, held: Tensor) -> Tensor:
        return held[:1].double().abs() * steps[row] * dt <= REACH

    mean = reading["sensor", "ensemble"].mean(1) / steps.clamp_min(1)
    return hold_last(mean, reading["observed"], reading["state"][0, VELOCITIES], near)


def integrate(velocity: Tensor, truth: Tensor, dt: float) -> Tensor:
    """Integrates velocities to states ``[N, 5]`` from the true first pose."""
    return torch.cat([dead_reckoning(velocity.double(), truth[0, :3].double(), dt), velocity.double()], -1)


def evaluate(
    recipe: KITTIRecipe, model: Filter, stream: Stream, cache: Path, *, filter_name: str, kind: str, seed: int
) -> tuple[list[dict], dict[str, TensorDict]]:
    """Returns all rows of the table for one drive, and its beliefs by condition, for the plots."""
    clean = read_spans(model["sensor"], Part(stream), cache, kind)
    pairs = [("clean", all_frames(clean))]
    for condition in DISTURBANCES:
        part = Part(replace(stream, condition=condition))
        pairs.append((condition, all_frames(read_spans(model["sensor"], part, cache, kind))))
    pairs += [("missing", lose_frames(clean, seed=stream.seed() + number)) for number in range(MASKS)]
    first = pairs[0][1][:TIMED]
    costs = cost(model, lambda: run_filter(recipe, model, [first]), len(first))
    rows, beliefs = defaultdict(list), {}
    truth, dt = clean["state"].double(), recipe.facts.dt

    def add(name: str, condition: str, reading: TensorDict, states: Tensor, scores: dict[str, float]) -> None:
        common = {"sensor": kind, "drive": stream.name, "condition": condition, "seed": seed, "filter": name}
        common["blind"] = 1 - float(reading["observed"][1:].float().mean())
        for row in errors(states, truth):
            rows[condition, name, row["window"]].append({**common, **row, **scores})

    for draw in range(DRAWS):
        out = run_filter(recipe, model, [reading for _, reading in pairs], seed=draw)
        for (condition, reading), belief in zip(pairs, out, strict=True):
            beliefs.setdefault(condition, belief)
            states = belief["belief", "mean"][:, :5].double()
            add(filter_name, condition, reading, states, {**calibration(belief), **costs})
        if "ensemble" not in out["belief"]:
            break  # deterministic
    for condition, reading in pairs:
        add("dead_reckoning", condition, reading, integrate(last_velocities(reading, dt), truth, dt), {})
    add("floor", "clean", pairs[0][1], integrate(truth[:, VELOCITIES], truth, dt), {})
    means = {key: _mean(group) for key, group in rows.items()}
    for (condition, name, window), row in means.items():
        own = means[condition, "dead_reckoning", window]["translation_m_per_m"]
        if name == filter_name:
            row["of_dead_reckoning"] = row["translation_m_per_m"] / own
    return list(means.values()), beliefs


def _mean(rows: list[dict]) -> dict:
    """Returns the mean of rows that differ only by the random draw of missing frames and noise."""
    mean = {
        key: fmean(row[key] for row in rows) if isinstance(value, float) else value for key, value in rows[0].items()
    }
    return {**mean, "spread_m_per_m": pstdev(row["translation_m_per_m"] for row in rows)}


def errors(states: Tensor, truth: Tensor) -> list[dict]:
    """Returns errors of a path by window; errors without a window are repeated in each row."""
    velocity = state_errors(states[1:, VELOCITIES], truth[1:, VELOCITIES])
    whole = {
        "rmse_v_m_per_s": float(velocity.rmse[0]),
        "mae_v_m_per_s": float(velocity.mae[0]),
        "rmse_theta_dot_deg_per_s": float(velocity.rmse[1].rad2deg()),
        "mae_theta_dot_deg_per_s": float(velocity.mae[1].rad2deg()),
        # The CRPS of a point estimate; that of a belief replaces it.
        "crps_v_m_per_s": float(velocity.mae[0]),
        "crps_theta_dot_deg_per_s": float(velocity.mae[1].rad2deg()),
    }
    try:
        devkit = kitti_devkit_error(states[:, :3], truth[:, :3])
        whole |= {"devkit_t_rel_percent": float(devkit.translation), "devkit_r_rel_deg_per_m": float(devkit.rotation)}
    except ValueError:  # shorter than 100 m
        pass
    table = []
    for window in [window for window in WINDOWS if window < len(truth)] or [len(truth) - 1]:
        end = kitti_endpoint_error(states[:, :3], truth[:, :3], window=window)
        length = kitti_pathlength_error(states[:, :3], truth[:, :3], windows=[window])
        table.append(
            {
                **whole,
                "window": window,
                "translation_m_per_m": float(end.translation),
                "rotation_deg_per_m": float(end.rotation),
                "pathlength_m_per_m": float(length.translation),
                "pathlength_deg_per_m": float(length.rotation),
            }
        )
    return table


def calibration(belief: TensorDict) -> dict[str, float]:
    """Returns the calibration of (v, theta_dot) over all rows but the first, which is given."""
    equal = "ensemble" in belief["belief"] and "log_weight" not in belief["belief"]
    members = belief["belief", "ensemble"].shape[1] if equal else None
    mean, variance, truth = (value.double() for value in counted(belief, VELOCITIES, FLOOR))
    covered = interval_coverage(mean, variance, truth, level=0.9)
    covariance, crps = torch.diag_embed(variance), crps_gaussian(mean, variance, truth).mean(0)
    return {
        "coverage90": float(covered.mean()),
        "coverage90_v": float(covered[0]),
        "coverage90_theta_dot": float(covered[1]),
        "crps_v_m_per_s": float(crps[0]),
        "crps_theta_dot_deg_per_s": float(crps[1].rad2deg()),
        "nll": float(-gaussian_log_prob(truth, mean, covariance).mean()),
        "nees": float(nees(mean, covariance, truth).mean),
        "spread_skill": float(spread_skill_ratio(mean, variance, truth, members).mean()),
    }
