"""Smoothers with trained sensors, on recordings: the errors of filter and smoother on the same frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import pandas as pd
import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arguments import made_by
from benchmarks.common.tables import head, line
from benchmarks.smoothing import gaussian
from benchmarks.smoothing.gaussian import Series
from benchmarks.smoothing.recordings import Group, Task, tasks
from torch_denkf.smoothers import EnKS, EnRTS, RTSSmoother

LAG = 10
SENSOR = ("rmse_sensor", "sensor_error_acf1", "sensor_error_acf10")  # size, and correlation 1 and LAG steps later
COLUMNS = (
    *("task", "group", "recording", "quantity", "method", "members", "lag", "draws"),
    *("rmse_filter", "rmse_smoother"),
    *SENSOR,
)
BELIEF, SMOOTHED = ("belief", "mean"), ("smoothed", "mean")


def mean_square(mean: Tensor, truth: Tensor) -> Tensor:
    """Returns mean square errors ``[N, D]`` over the times with a reading before and ``LAG`` later ones."""
    return (mean - truth)[:, 1:-LAG].square().mean(1)


def rows_of(task: Task, group: str, names: str, before: Tensor, after: Tensor, **more) -> list[dict]:
    """Returns a row for each recording and quantity, from mean squares ``[N, D]`` of filter and smoother."""
    recordings = names.split() if len(names.split()) == len(before) else [names]
    if len(recordings) < len(before):
        before, after = before.mean(0, keepdim=True), after.mean(0, keepdim=True)
    common = {"task": task.name, "group": group, "lag": LAG, **more}
    return [
        {
            **common,
            "recording": recording,
            "quantity": quantity,
            "rmse_filter": float(before[n, d]) ** 0.5,
            "rmse_smoother": float(after[n, d]) ** 0.5,
        }
        for n, recording in enumerate(recordings)
        for d, quantity in enumerate(task.quantities)
    ]


@torch.no_grad()
def ensembles(make: Callable[[], Task], place: int, readings: Path, draws: int) -> list[dict]:
    """Returns rows of the trained filter with its ensemble smoothers, for one number of members."""
    task, rows = make(), []
    members = task.members[place]
    filter = task.behind(task.model(members))
    for group, batches in task.groups(members, readings).items():
        for names, batch in batches.items():
            truth = batch["state"][..., task.dims]
            for method in (EnKS, EnRTS):
                errors = []
                for seed in range(draws):
                    torch.manual_seed(seed)
                    out = method(filter, LAG).sequence(batch.copy(), keep=[BELIEF])
                    errors.append([mean_square(out[key][..., task.dims], truth) for key in (BELIEF, SMOOTHED)])
                before, after = (torch.stack(each).mean(0) for each in zip(*errors, strict=True))
                more = {"method": method.__name__, "members": members, "draws": draws}
                rows += rows_of(task, group, names, before, after, **more)
    return rows


def series_of(task: Task, batches: Group) -> dict[str, Series]:
    """Returns the scored quantities of a group, in double precision."""
    out = {}
    for names, batch in batches.items():
        reading = batch["sensor", "ensemble"].mean(-2).double()
        reading = reading[..., task.dims] if reading.shape[-1] > len(task.dims) else reading
        target = batch["action"].double() if batch.get("action", None) is not None else None
        out[names] = Series(batch["state"][..., task.dims].double(), reading, batch["observed"], target)
    return out


def gaussians(make: Callable[[], Task], readings: Path, updates: int) -> list[dict]:
    """Returns rows of the Kalman filter and its smoother, with size and correlations of the sensor's errors."""
    task, rows = make(), []
    groups = {name: series_of(task, each) for name, each in task.groups(task.members[0], readings).items()}
    chosen = list(groups["validation"].values())
    models = [gaussian.model_of(gaussian.fit(chosen, lag, updates), chosen) for lag in (0, LAG)]
    for group, batches in groups.items():
        for names, series in batches.items():
            say = partial(rows_of, task, group, names)
            one, own = (kalman(model, series) for model in models)
            rows += say(*one, method="RTS, the filter's model")
            error, smoothed = (series.reading - series.truth)[:, 1:], say(one[0], own[1], method="RTS")
            sensor = torch.stack([error.square().mean(1).sqrt(), correlation(error, 1), correlation(error, LAG)], -1)
            if len(smoothed) < sensor[..., 0].numel():  # a row for all recordings
                sensor[..., 0] = sensor[..., 0].square().mean(0).sqrt()
                sensor = sensor.mean(0, keepdim=True)
            for row, numbers in zip(smoothed, sensor.flatten(0, 1).tolist(), strict=True):
                row |= dict(zip(SENSOR, numbers, strict=True))
            rows += smoothed
    return rows


@torch.no_grad()
def kalman(model: gaussian.Model, series: Series) -> tuple[Tensor, Tensor]:
    """Returns the mean squares of the library's filter and smoother, ``[N, D]``."""
    data = {"observation": series.reading, "observed": series.observed}
    data["action"] = torch.zeros_like(series.truth) if series.target is None else series.target
    frames = TensorDict(data, series.truth.shape[:2])
    out = RTSSmoother(gaussian.kalman_filter(model), LAG).sequence(frames, keep=[BELIEF])
    before, after = (mean_square(out[key][..., ::3], series.truth) for key in (BELIEF, SMOOTHED))
    return before, after


def correlation(error: Tensor, lag: int) -> Tensor:
    """Returns the correlation of errors ``[N, T, D]`` with those ``lag`` steps later, ``[N, D]``."""
    return (error[:, lag:] * error[:, :-lag]).mean(1) / error.square().mean(1)


Jobs = dict[Path, Callable[[], list[dict]]]


def jobs(root: Path | None, out: Path, smoke: bool) -> Jobs:
    """Returns independent jobs by the file of their rows."""
    made: Jobs = {}
    large: Jobs = {}
    parts, readings = out / "parts", out / "readings"
    for make in tasks(root, out, smoke=smoke):
        task = make()
        for place, members in enumerate(task.members):
            # A large ensemble's errors hardly depend on its noise.
            draws = 1 if smoke or place else task.draws
            job = partial(ensembles, make, place, readings, draws)
            (large if place else made)[parts / f"{task.name}-{members}.json"] = job
        made[parts / f"{task.name}-gaussian.json"] = partial(gaussians, make, readings, 2 if smoke else 60)
    return made | large


def page(rows: Sequence[dict]) -> str:
    """Returns means over the recordings of each group."""
    lines = [
        "# Smoothers behind trained sensors",
        "",
        f"Root mean square errors with {LAG} later readings, and those of the filter on the same frames; means over",
        "the recordings. *Less* is how much of the filter's error the smoother takes away.",
        "",
        *head("task", "recordings", "quantity", "method", "members", "filter", "smoother", "less"),
    ]
    table, keys = pd.DataFrame(rows, columns=COLUMNS), ["task", "group", "quantity", "method", "members"]
    table["less"] = 1 - table["rmse_smoother"] / table["rmse_filter"]
    means = table.groupby(keys, sort=False, dropna=False)[["rmse_filter", "rmse_smoother", "less", *SENSOR]].mean()
    for row in means.reset_index().itertuples():
        members = "" if row.members != row.members else f"{row.members:.0f}"
        cells = [f"{row.rmse_filter:.4f}", f"{row.rmse_smoother:.4f}", f"{row.less:.1%}"]
        lines.append(line(row.task, row.group, row.quantity, row.method, members, *cells))
    lines += ["", "How long a sensor's errors last: their correlation one step and ten steps later.", ""]
    lines += head("task", "recordings", "quantity", "sensor", "one step", f"{LAG} steps")
    for row in means.dropna(subset=SENSOR[0]).reset_index().itertuples():
        cells = [f"{row.rmse_sensor:.4f}", f"{row.sensor_error_acf1:.2f}", f"{row.sensor_error_acf10:.2f}"]
        lines.append(line(row.task, row.group, row.quantity, *cells))
    return "\n".join([*lines, "", *made_by("smoothing")]) + "\n"
