"""Smoothers behind trained sensors, on recordings: the errors of filter and smoother on the same frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from statistics import fmean

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arguments import made_by
from benchmarks.common.tables import Columns, head, line, pick
from benchmarks.smoothing import gaussian, linear
from benchmarks.smoothing.gaussian import Series
from benchmarks.smoothing.recordings import Group, Task, tasks
from torch_denkf.smoothers import EnKS, EnRTS, RTSSmoother

LAG = 10
LESS = 0.15  # share of the filter's error that a smoother is to take away
COLUMNS = Columns(
    names=(
        "task",
        "group",
        "recording",
        "quantity",
        "method",
        "members",
        "lag",
        "draws",
        "rmse_filter",
        "rmse_smoother",
        "rmse_sensor",
        "sensor_error_acf1",
        "sensor_error_acf10",
    ),
    text=("task", "group", "recording", "quantity", "method"),
    whole=("members", "lag", "draws"),
    order=lambda row: tuple(str(row.get(key, "")) for key in COLUMNS.names[:6]),
)
BELIEF, SMOOTHED = ("belief", "mean"), ("smoothed", "mean")


def mean_square(mean: Tensor, truth: Tensor) -> Tensor:
    """Over the times that have a reading before and ``LAG`` later ones, ``[N, D]``."""
    return (mean - truth)[:, 1:-LAG].square().mean(1)


def rows_of(task: Task, group: str, names: str, before: Tensor, after: Tensor, **more) -> list[dict]:
    """A row for each recording and quantity, from mean squares ``[N, D]`` of filter and smoother."""
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
    """The trained filter with its ensemble smoothers, for one number of members."""
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
    """The scored quantities of a group, in double precision."""
    out = {}
    for names, batch in batches.items():
        reading = batch["sensor", "ensemble"].mean(-2).double()
        reading = reading[..., task.dims] if reading.shape[-1] > len(task.dims) else reading
        target = batch["action"].double() if batch.get("action", None) is not None else None
        out[names] = Series(batch["state"][..., task.dims].double(), reading, batch["observed"], target)
    return out


def gaussians(make: Callable[[], Task], readings: Path, updates: int) -> list[dict]:
    """The Kalman filter behind the same sensor, its smoother, and the best weights of the readings."""
    task, rows = make(), []
    groups = {name: series_of(task, each) for name, each in task.groups(task.members[0], readings).items()}
    chosen = list(groups["validation"].values())
    models = [gaussian.model_of(gaussian.fit(chosen, lag, updates), chosen) for lag in (0, LAG)]
    found = [linear.weights(chosen, later) for later in (0, LAG)]
    for group, batches in groups.items():
        for names, series in batches.items():
            say = partial(rows_of, task, group, names)
            one, own = (kalman(model, series) for model in models)
            rows += say(*one, method="RTS, the filter's model")
            rows += say(one[0], own[1], method="RTS")
            error = (series.reading - series.truth)[:, 1:]
            weighted = [linear.estimates(series, w, later) for w, later in zip(found, (0, LAG), strict=True)]
            linears = say(*(mean_square(mean, series.truth) for mean in weighted), method="best weights")
            sensor, *acf = (error.square().mean(1), correlation(error, 1), correlation(error, LAG))
            shown = [each.mean(0, keepdim=True) if len(linears) < each.numel() else each for each in (sensor, *acf)]
            for row, (square, near, far) in zip(linears, zip(*(s.flatten() for s in shown), strict=True), strict=True):
                row |= {"rmse_sensor": float(square) ** 0.5}
                row |= {"sensor_error_acf1": float(near), "sensor_error_acf10": float(far)}
            rows += linears
            # Fitted on the very recordings that they are scored on: no weights of these readings do better.
            best = [linear.estimates(series, linear.weights([series], later), later) for later in (0, LAG)]
            rows += say(*(mean_square(mean, series.truth) for mean in best), method="best weights, in hindsight")
    return rows


@torch.no_grad()
def kalman(model: gaussian.Model, series: Series) -> tuple[Tensor, Tensor]:
    """Mean squares of the library's filter and smoother, ``[N, D]``."""
    data = {"observation": series.reading, "observed": series.observed}
    data["action"] = torch.zeros_like(series.truth) if series.target is None else series.target
    frames = TensorDict(data, series.truth.shape[:2])
    out = RTSSmoother(gaussian.kalman_filter(model), LAG).sequence(frames, keep=[BELIEF])
    before, after = (mean_square(out[key][..., ::3], series.truth) for key in (BELIEF, SMOOTHED))
    return before, after


def correlation(error: Tensor, lag: int) -> Tensor:
    """Of errors ``[N, T, D]`` with those ``lag`` steps later, ``[N, D]``."""
    return (error[:, lag:] * error[:, :-lag]).mean(1) / error.square().mean(1)


Jobs = dict[Path, Callable[[], list[dict]]]


def jobs(root: Path | None, out: Path, smoke: bool) -> Jobs:
    """Returns what writes which file, each on its own."""
    made: Jobs = {}
    large: Jobs = {}
    parts, readings = out / "parts", out / "readings"
    for make in tasks(root, out, smoke=smoke):
        task = make()
        for place, members in enumerate(task.members):
            # A large ensemble's errors hardly move with its noise.
            draws = 1 if smoke or place else task.draws
            job = partial(ensembles, make, place, readings, draws)
            (large if place else made)[parts / f"{task.name}-{members}.json"] = job
        made[parts / f"{task.name}-gaussian.json"] = partial(gaussians, make, readings, 2 if smoke else 60)
    return made | large


def page(rows: Sequence[dict]) -> str:
    """Means over the recordings of each group."""
    lines = [
        "# Smoothers behind trained sensors",
        "",
        f"Root mean square errors with {LAG} later readings, and those of the filter on the same frames; means over",
        f'the recordings. "Less" is how much of the filter\'s error the smoother takes away; the target is {LESS:.0%}.',
        "",
        *head("task", "recordings", "quantity", "method", "members", "filter", "smoother", "less", "met"),
    ]
    keys = ("task", "group", "quantity", "method", "members")
    for found in dict.fromkeys(tuple(row.get(key) for key in keys) for row in rows):
        own = pick([{"members": None, **row} for row in rows], **dict(zip(keys, found, strict=True)))
        before, after = (fmean(row[f"rmse_{name}"] for row in own) for name in ("filter", "smoother"))
        less = 1 - fmean(row["rmse_smoother"] / row["rmse_filter"] for row in own)
        cells = [*found[:4], found[4] or "", f"{before:.4f}", f"{after:.4f}", f"{less:.1%}"]
        lines.append(line(*cells, "yes" if less >= LESS else "no"))
    lines += ["", "How long a sensor's errors last: their correlation one step and ten steps later.", ""]
    lines += head("task", "recordings", "quantity", "sensor", "one step", f"{LAG} steps")
    sensors = [row for row in rows if "rmse_sensor" in row]
    for found in dict.fromkeys(tuple(row[key] for key in keys[:3]) for row in sensors):
        own = pick(sensors, **dict(zip(keys, found, strict=False)))
        values = [fmean(row[key] for row in own) for key in COLUMNS.names[-3:]]
        lines.append(line(*found, f"{values[0]:.4f}", *(f"{value:.2f}" for value in values[1:])))
    return "\n".join([*lines, "", *made_by("smoothing")]) + "\n"
