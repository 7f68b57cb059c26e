"""Errors of a car filter on drives with known poses, compared with dead reckoning on the same readings."""

from __future__ import annotations

import csv
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf._checks import check_number
from torch_denkf.applications.car.metrics.devkit import kitti_devkit_error
from torch_denkf.applications.car.metrics.odometry import dead_reckoning, kitti_endpoint_error
from torch_denkf.applications.car.odometry.filter import VELOCITIES, CarFilter
from torch_denkf.applications.car.odometry.scores import filter_readings, first_state
from torch_denkf.applications.car.odometry.streams import Drive, all_frames, lose_frames, read_spans
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.deployment.files import replacing
from torch_denkf.deployment.progress import progress_bar
from torch_denkf.metrics import interval_coverage

__all__ = ["COLUMNS", "evaluate_car_filter", "markdown_table", "write_rows"]

COLUMNS = (
    "drive",
    "method",
    "frames",
    "window",
    "translation_m_per_m",
    "rotation_deg_per_m",
    "devkit_t_rel_percent",
    "devkit_r_rel_deg_per_m",
    "coverage90_v",
    "coverage90_theta_dot",
    "blind",
)


def evaluate_car_filter(
    car: CarFilter,
    root: str | Path,
    drives: Sequence[str],
    *,
    cache: str | Path | bool = True,
    camera: str | None = None,
    size: tuple[int, int] | None = None,
    height: float = KITTI_HEIGHT,
    pitch: float = 0.0,
    missing: float = 0.0,
    draws: int = 8,
    window: int = 100,
    seed: int = 0,
    progress: bool = True,
) -> tuple[list[dict[str, Any]], dict[str, TensorDict]]:
    """Runs a filter on whole drives and compares its path with the true one.

    Each run begins at the true pose with the sensor's first reading of the velocities. Errors are means over several
    draws of the filter's noise (and of the missing frames).

    ============================ ======================================================================================
    entry of a row               content
    ============================ ======================================================================================
    ``drive``, ``method``        ``"filter"``, ``"dead reckoning"`` (the sensor's mean readings, integrated), or
                                 ``"floor"`` (the true velocities, integrated)
    ``frames``, ``window``       number of frames; steps of the end point errors
    ``translation_m_per_m``      end point error, see ``metrics.odometry.kitti_endpoint_error``
    ``rotation_deg_per_m``       heading error at the end points
    ``devkit_t_rel_percent``,    of the planar path, as ``metrics.devkit.kitti_devkit_error`` computes it; left
    ``devkit_r_rel_deg_per_m``   out below 100 m
    ``coverage90_v``,            share of the true speeds, and of the true turn rates, in the filter's 90 % intervals
    ``coverage90_theta_dot``
    ``blind``                    share of the frames without a frame pair
    ============================ ======================================================================================

    Args:
        car: the filter.
        root: folder in KITTI's layout, with ``sequences`` and ``poses``.
        drives: names of drives.
        cache: folder for the flow; ``True`` for the library's.
        camera: folder of the images; by default the first that has any.
        size: (H, W) of the scaled images; by default that of the training.
        height: height of the camera over the road, in m.
        pitch: upward pitch of the camera, in rad; see :func:`torch_denkf.applications.car.track`.
        missing: share of the frames to drop.
        draws: number of draws of the noise.
        window: steps of the end point errors; the whole drive if it is shorter.
        seed: seed of the noise.
        progress: whether to show a progress bar.

    Returns:
        Rows, a dictionary for each drive and method; and the filter's beliefs of the first draw by drive, ``[N]``.

    Raises:
        FileNotFoundError: if a drive does not exist.
        ValueError: if a share, a number of draws, a window or the pitch is out of range, or a drive's frame time
            differs from the filter's step.
    """
    if not 0 <= missing < 1 or draws < 1 or window < 1:
        raise ValueError(f"missing is in [0, 1), draws and window at least 1; got {missing}, {draws} and {window}")
    check_number("pitch", pitch, least=-0.5, most=0.5, cure="It is how far the camera looks up, in rad")
    longest, rows, beliefs = car.settings.longest, [], {}
    with progress_bar("evaluating", len(drives), unit=" drives", shown=progress) as bar:
        for name in drives:
            drive = Drive(
                Path(root),
                name,
                car.settings.size if size is None else size,
                cache,
                camera=camera,
                height=height,
                pitch=pitch,
                two_view=car.settings.two_view,
            )
            data = [each.read() for each in drive.spans(longest if missing else 1)]
            dt = float(data[0]["dt"][0, 0])
            if abs(dt / car.settings.dt - 1) > 0.05:
                raise ValueError(f"drive {name} has a frame each {dt:.3g} s, the filter steps of {car.settings.dt:g} s")
            spans = read_spans(car.sensor, data, longest)
            runs = [lose_frames(spans, seed + n, missing) if missing else all_frames(spans) for n in range(draws)]
            out = filter_readings(car, runs, seed=seed)
            beliefs[name] = out[0]
            rows += _rows(name, car, out, runs, min(window, len(data[0]) - 1))
            bar.update()
    return rows, beliefs


def _rows(name: str, car: CarFilter, out: TensorDict, runs: Sequence[TensorDict], window: int) -> list[dict[str, Any]]:
    truth, dt = runs[0]["state"].double(), car.settings.dt
    covered = interval_coverage(
        out["belief", "mean"][:, 1:, VELOCITIES].flatten(0, 1).double(),
        out["belief", "var"][:, 1:, VELOCITIES].flatten(0, 1).double(),
        out["state"][:, 1:, VELOCITIES].flatten(0, 1).double(),
        level=0.9,
    )
    common = {"drive": name, "frames": len(truth), "window": window}
    common["blind"] = 1 - fmean(float(run["observed"][1:].float().mean()) for run in runs)
    estimates = {
        "filter": [mean[:, :3].double() for mean in out["belief", "mean"]],
        "dead reckoning": [dead_reckoning(_held(run, car).double(), truth[0, :3], dt) for run in runs],
        "floor": [dead_reckoning(truth[:, VELOCITIES], truth[0, :3], dt)],
    }
    rows = []
    for method, paths in estimates.items():
        scores = defaultdict(list)
        for path in paths:
            for key, value in path_errors(path, truth[:, :3], window).items():
                scores[key].append(value)
        row = {**common, "method": method, **{key: fmean(values) for key, values in scores.items()}}
        if method == "filter":
            row |= {"coverage90_v": float(covered[0]), "coverage90_theta_dot": float(covered[1])}
        rows.append(row)
    return rows


def path_errors(path: Tensor, truth: Tensor, window: int) -> dict[str, float]:
    """Returns errors of one path ``[N, 3]`` against the true one."""
    end = kitti_endpoint_error(path, truth, window=window)
    errors = {"translation_m_per_m": float(end.translation), "rotation_deg_per_m": float(end.rotation)}
    try:
        devkit = kitti_devkit_error(path, truth)
    except ValueError:  # shorter than 100 m
        return errors
    return errors | {
        "devkit_t_rel_percent": float(devkit.translation),
        "devkit_r_rel_deg_per_m": float(devkit.rotation),
    }


def _held(reading: TensorDict, car: CarFilter) -> Tensor:
    """Returns the sensor's mean velocities ``[N, 2]`` with a zero-order hold over rows without a reading.

    A pair over a gap gives the mean over its steps, unless the motion exceeds the sensor's range.
    """
    mean, steps = reading["sensor", "ensemble"].mean(1), reading["steps"].squeeze(-1).tolist()
    held, path = first_state(reading)[VELOCITIES], []
    for row, seen in enumerate(reading["observed"].squeeze(-1).tolist()):
        if seen and (steps[row] == 1 or abs(float(held[0])) * steps[row] * car.settings.dt <= car.settings.reach):
            held = mean[row] / steps[row]
        path.append(held)
    return torch.stack(path)


def markdown_table(rows: Sequence[dict[str, Any]]) -> str:
    """Returns rows of :func:`evaluate_car_filter` as a Markdown table, with the mean over the drives."""
    lines = [
        "| drive | method | steps | m/m | deg/m | devkit % | devkit deg/m | coverage v | coverage theta_dot |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    drives, methods = (list(dict.fromkeys(row[key] for row in rows)) for key in ("drive", "method"))
    for drive in drives:
        lines += [_line(drive, [row]) for row in rows if row["drive"] == drive]
    if len(drives) > 1:
        lines += [_line(f"mean of {len(drives)}", [row for row in rows if row["method"] == name]) for name in methods]
    return "\n".join(lines) + "\n"


def _line(title: str, rows: Sequence[dict[str, Any]]) -> str:
    cells = [title, rows[0]["method"], " to ".join(dict.fromkeys(str(row["window"]) for row in rows))]
    for key, digits in zip(COLUMNS[4:10], (4, 4, 2, 4, 3, 3), strict=True):
        values = [row[key] for row in rows if key in row]
        cells.append(f"{fmean(values):.{digits}f}" if values else "")
    return f"| {' | '.join(cells)} |"


def write_rows(rows: Sequence[dict[str, Any]], file: str | Path) -> None:
    """Writes rows of :func:`evaluate_car_filter` as CSV, with ``COLUMNS``; missing values are empty."""
    with replacing(file) as beside, beside.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows(rows)
