"""The results of a fused log: a line for each sensor, the path in files, pictures, settings with learned noises."""

from __future__ import annotations

import json
import math
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.applications.robot.config import PLANE, write_config
from torch_denkf.applications.robot.learning import fix_error, scale_of
from torch_denkf.applications.robot.log import RobotLog
from torch_denkf.applications.robot.model import RobotModel
from torch_denkf.applications.robot.motion import ANGLES, STATES
from torch_denkf.data.earth import to_degrees

__all__ = ["draw", "gap_errors", "learned_settings", "sensor_lines", "write_path"]

_BELIEVED = 0.99  # of a reading's distance: beyond, it is none that the noise explains


def sensor_lines(model: RobotModel, log: RobotLog, out: TensorDict) -> list[str]:
    """Returns a table of each sensor's outliers, share of accepted readings, bias, delay, noise and drift."""
    heads = ["sensor", "reads", "readings", "outliers", "accepted", "bias", "residual"]
    heads += ["noise as given", "noise as learned"]
    lines = [f"| {' | '.join(heads)} | drift | offset |", "|" + "---|" * (len(heads) + 2)]
    for sensor in model.config.sensors:
        for group in sensor.groups:
            name = f"{sensor.name}_{group}"
            seen = out[f"{name}_observed"][:, 0]
            places = [place for place in model.reads[name] if not (model.config.two_d and place in PLANE)]
            size = len(places)
            nis = out.get(("info", name, "nis"), out["info", "nis"])[seen, 0]  # of one sensor without its name
            share = float((nis < _chi_square(size)).double().mean())
            residual = out[name][seen][:, :size] - out["smoothed", "mean"][seen][:, places]
            for at, place in enumerate(places):
                if place in ANGLES:
                    residual[:, at] = torch.atan2(residual[:, at].sin(), residual[:, at].cos())
            given = out[f"{name}_noise"][seen].diagonal(dim1=-2, dim2=-1)[:, :size].mean(0).sqrt()
            scale = scale_of(model, name).detach().exp()
            offset = log.offsets[sensor.topic].seconds if sensor.topic in log.offsets else -sensor.delay
            said = given if log.seen[name].stated else ["none"] * size
            with torch.no_grad():
                mean = out["smoothed", "mean"][seen].unsqueeze(-2)
                predicted = model.reading(name).compute(mean, out[name][seen]).squeeze(-2)
            bias = predicted[:, :size] - out["smoothed", "mean"][seen][:, places]
            sized = [_drift(model, name, at) for at in range(size)]
            drift = ["none" if each is None else f"{each[0]:.3g} for {each[1]:.3g} s" for each in sized]
            kept = residual.mean(0) if model.drifts is None else bias.mean(0)
            cells = [kept, (residual - bias).std(0), said, given * scale, drift]
            texts = ["; ".join(each if isinstance(each, str) else f"{each:.3g}" for each in cell) for cell in cells]
            reads = ", ".join(STATES[place] for place in places)
            far = log.outliers[sensor.name] if 0 in places else 0
            head = f"| {name} ({sensor.topic}) | {reads} | {int(seen.sum())} | {far} | {share:.1%} |"
            lines.append(f"{head} {' | '.join(texts)} | {offset:+.2f} s |")
    return lines


def _drift(model: RobotModel, name: str, at: int) -> tuple[float, float] | None:
    """Returns standard deviation and time constant (s) of a sensor's drift; ``None`` for a sensor without drift."""
    place = model.reading(name).slow[at]
    if place is None or model.drifts is None:
        return None
    drifts, place = model.drifts, place - len(STATES)
    return drifts.log_std[place].exp().item(), drifts.log_time[place].exp().item()


def _chi_square(dof: int) -> float:
    """Returns the quantile of a chi-square distribution, by Wilson and Hilferty."""
    part = 2 / (9 * dof)
    return dof * (1 - part + NormalDist().inv_cdf(_BELIEVED) * math.sqrt(part)) ** 3


def gap_errors(out: TensorDict, full: TensorDict, model: RobotModel) -> tuple[float, float, int]:
    """Root mean square error of the place at fixes that were hidden, the share of their x and y that lie in the 95 %
    intervals of such a fix, its own noise and drift included, and how many there are.
    """
    errors, held = [], []
    for name, reads in model.reads.items():
        if tuple(reads[:2]) == (0, 1):
            hidden = (full[f"{name}_observed"] & ~out[f"{name}_observed"])[:, 0]
            with torch.no_grad():
                error, cov = (value[hidden] for value in fix_error(model, name, out.clone().update(full.select(name))))
            errors.append(error.square().sum(-1))
            held.append(error.abs() < 1.96 * cov.diagonal(dim1=-2, dim2=-1).sqrt())
    every = torch.cat(errors) if errors else torch.zeros(0)
    if not len(every):
        return math.nan, math.nan, 0
    return float(every.mean().sqrt()), float(torch.cat(held).double().mean()), len(every)


def learned_settings(model: RobotModel, log: RobotLog, rows: TensorDict) -> dict[str, Any]:
    """Returns the settings that were learned: process noise, and delays, variances and drifts of the sensors."""
    process = next(part for part in model.filter.modules() if hasattr(part, "log_scale") and hasattr(part, "dynamic"))
    scale = process.log_scale.detach().exp()
    cov: Tensor = process.cov * scale * scale.unsqueeze(-1)
    changed: dict[str, Any] = {"process_noise_covariance": [float(f"{each:.6g}") for each in cov.flatten().tolist()]}
    for sensor in model.config.sensors:
        variances, drifts, times = [0.0] * len(STATES), [0.0] * len(STATES), list(sensor.drift_time)
        for group in sensor.groups:
            name = f"{sensor.name}_{group}"
            kept = scale_of(model, name).detach().exp().square()
            mean = rows[f"{name}_noise"][rows[f"{name}_observed"][:, 0]].mean(0).diagonal()[: len(kept)]
            back = 6 if sensor.differential and group == "pose" else 0
            for at, (place, variance) in enumerate(zip(model.reads[name], (mean * kept).tolist(), strict=False)):
                variances[place - back] = float(f"{variance:.6g}")
                if drift := _drift(model, name, at):
                    drifts[place - back] = float(f"{drift[0]:.6g}")
                    times[place - back] = float(f"{drift[1]:.6g}")
        if any(drifts):
            changed |= {f"{sensor.name}_drifts": drifts, f"{sensor.name}_drift_time": times}
        changed[f"{sensor.name}_variances"] = variances
        if not sensor.delay and sensor.topic in log.offsets:
            changed[f"{sensor.name}_delay"] = round(-log.offsets[sensor.topic].seconds, 3)
    return changed


def write_path(folder: Path, model: RobotModel, log: RobotLog, out: TensorDict) -> list[str]:
    """Writes the smoothed path as CSV and TUM, where degrees are known as GeoJSON, and the settings as YAML.

    Returns:
        The names of the files.
    """
    mean, std = (out["smoothed", name][:, : len(STATES)].numpy() for name in ("mean", "var"))
    stamp, names = out["stamp"].numpy(), ["path.csv", "path.tum", "ekf.yaml"]
    kept = np.append(np.diff(stamp[:, 0]) > 0, True)  # the last row of each time
    stamp, mean, std = stamp[kept], mean[kept], np.sqrt(std[kept])
    head = ",".join(["time", *STATES, *(f"std_{state}" for state in STATES)])
    np.savetxt(folder / "path.csv", np.c_[stamp, mean, std], "%.9f", ",", header=head, comments="")
    half = mean[:, 3:6] / 2
    (sr, sp, sy), (cr, cp, cy) = np.sin(half).T, np.cos(half).T
    turned = np.c_[sr * cp * cy - cr * sp * sy, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy]
    turned = np.c_[turned, cr * cp * cy + sr * sp * sy]
    np.savetxt(folder / "path.tum", np.c_[stamp, mean[:, :3], turned], "%.9f")
    if log.origin is not None:
        places = to_degrees(mean[:, :2], log.origin)[:, ::-1].round(8).tolist()
        line = {"type": "Feature", "properties": {}, "geometry": {"type": "LineString", "coordinates": places}}
        (folder / "path.geojson").write_text(json.dumps(line), "utf-8")
        names.append("path.geojson")
    write_config(model.config, folder / "ekf.yaml", learned_settings(model, log, out))
    return names


def draw(file: Path, model: RobotModel, out: TensorDict) -> None:
    """Draws the path with its readings, and the place and heading over time with bands of 95 %.

    Raises:
        ImportError: without matplotlib.
    """
    from torch_denkf.plots import plot_bands, plot_path

    poses = [name for name, reads in model.reads.items() if tuple(reads[:2]) == (0, 1)]
    readings = None
    if poses:
        readings = torch.where(out[f"{poses[0]}_observed"], out[poses[0]][:, :2], torch.nan)
    axes = plot_path(out, belief="smoothed", readings=readings, spread="ellipses", level=0.95)
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.savefig(file, dpi=120)
    time = (out["stamp"] - out["stamp"][0]).squeeze(-1)
    shown = {0: readings[:, 0], 1: readings[:, 1]} if readings is not None else None
    bands = plot_bands(
        out,
        belief="smoothed",
        dims=[0, 1, 5, 6],
        names=["x, m", "y, m", "yaw, rad", "speed, m/s"],
        readings=shown,
        time=time,
        level=0.95,
    )
    second = bands[0].get_figure(root=True)
    assert second is not None
    second.savefig(file.with_name("bands.png"), dpi=120)
