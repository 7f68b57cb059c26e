"""The study: its options, its rows, its table and its picture."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.plots import plt, save
from benchmarks.common.tables import Columns, head, line, write_page
from benchmarks.occlusion.task import HEIGHT, KINDS, PILLAR, RATE, WIDTH, drawn, filter_of, read, runs
from benchmarks.occlusion.training import fit_camera, fit_filter, lasting_error
from torch_denkf.filters import Filter

LEVEL = 0.9  # of the intervals
SETTLED = 10  # steps that are not scored: a filter does not know where the ball is
LSTM = 8  # times as many iterations: it must learn the motion, and its steps take an eighth of the time
WHEN = ("seen", "hidden", "after")
#: What a filter knows of its camera, and which filters can.
KNOWS = {
    "nothing": ("DEnKF", "EKF", "particle filter", "LSTM"),
    "errors last": ("DEnKF", "EKF"),
    "visibility, no labels": ("DEnKF", "EKF", "particle filter"),
    "visibility": ("DEnKF", "EKF", "particle filter"),
    "visibility, errors last": ("DEnKF", "EKF"),
}
COLUMNS = Columns(
    names=("filter", "knows", *(f"{name}_{when}" for when in WHEN for name in ("error", "coverage")), "seconds"),
    text=("filter", "knows"),
    whole=(),
    order=lambda row: (
        list(KINDS).index(row["filter"]) if row["filter"] in KINDS else -1,
        list(KNOWS).index(row["knows"]),
    ),
)


@dataclass(frozen=True)
class Study:
    """What does a filter believe of a ball behind a pillar?"""

    out: Path | None = None  # folder for occlusion.csv, occlusion.md and occlusion.png
    camera_runs: int = 120  # that the camera is trained on, of 100 steps
    filter_runs: int = 200  # that the filters are trained on
    test_runs: int = 200  # of 150 steps
    epochs: int = 6  # of the camera
    iterations: int = 80  # of each filter
    window: int = 60  # steps of a training window
    batch: int = 32
    seed: int = 0
    smoke: bool = False  # a few steps of everything: does it run?


def times(data: TensorDict) -> dict[str, Tensor]:
    """When the ball is seen, hidden, and in the second after it came back, ``[runs, steps]``."""
    visible = data["visible"].squeeze(-1)
    hidden, seen = visible == 0, visible == 1
    recent = torch.zeros_like(hidden)
    for back in range(1, 2 * RATE):
        recent[:, back:] |= hidden[:, :-back]
    since = torch.zeros_like(visible)
    for t in range(1, seen.shape[1]):
        since[:, t] = torch.where(seen[:, t], since[:, t - 1] + 1, 0)
    after = seen & recent & (since <= RATE)
    late = torch.arange(visible.shape[1]) >= SETTLED
    return {name: mask & late for name, mask in zip(WHEN, (seen & ~after, hidden, after), strict=True)}


def scores(mean: Tensor, var: Tensor | None, data: TensorDict) -> dict[str, float]:
    """Root mean square error of the place in pixels, and the share of coordinates within the intervals."""
    error, found = mean - data["state"][..., :2], {}
    for when, mask in times(data).items():
        found[f"error_{when}"] = error[mask].square().sum(-1).mean().sqrt().item()
        if var is not None:
            half = NormalDist().inv_cdf((1 + LEVEL) / 2) * var[mask].sqrt()
            found[f"coverage_{when}"] = (error[mask].abs() <= half).float().mean().item()
    return found


@torch.no_grad()
def believed(filter: Filter, data: TensorDict, seed: int) -> TensorDict:
    """What a filter makes of the readings."""
    torch.manual_seed(seed)
    return filter.sequence(data.clone())


def page(rows: list[dict], study: Study) -> str:
    """The table."""
    lines = [
        "# A ball behind a pillar",
        "",
        f"Root mean square error of the place, in pixels, and the share of its coordinates within their {LEVEL:.0%} "
        f"intervals: {study.test_runs} runs of 15 s, without their first second. *After* is the first second in which "
        "the whole ball is seen again.",
        "",
        *head("filter", "knows of its camera", *(f"{when}, {what}" for when in WHEN for what in ("px", "within"))),
    ]
    for row in rows:
        cells = []
        for when in WHEN:
            share = row.get(f"coverage_{when}")
            cells += [f"{row[f'error_{when}']:.2f}", "" if share is None else f"{100 * share:.0f} %"]
        lines.append(line(row["filter"], row["knows"], *cells))
    lines += ["", *made_by("occlusion")]
    return "\n".join(lines) + "\n"


def draw(outs: dict[str, TensorDict], data: TensorDict, file: Path) -> None:
    """Pictures of one run, and what two filters believe in it."""
    hidden = (data["visible"].squeeze(-1) == 0).float()
    run = int((hidden[:, 40:80].sum(1) - 20).abs().argmin())  # about 20 steps behind the pillar
    span = torch.arange(20, 110)
    figure, axes = plt.subplots(4, 1, figsize=(8, 8), height_ratios=[1.3, 2, 2, 1], layout="constrained")
    shown = span[:: len(span) // 8][:8]
    strip = torch.cat([drawn(data["state"][run, t], int(t))[0] for t in shown], -1)
    axes[0].imshow(strip, cmap="gray", vmin=0, vmax=255)
    axes[0].set_xticks([WIDTH * (n + 0.5) for n in range(len(shown))], [f"{t / RATE:.1f} s" for t in shown.tolist()])
    axes[0].set_yticks([])
    second = span / RATE
    for axis, (component, name, size) in zip(axes[1:3], ((0, "x, px", WIDTH), (1, "y, px", HEIGHT)), strict=True):
        for label, out in outs.items():
            mean, std = out["belief", "mean"][run, span, component], out["belief", "var"][run, span, component].sqrt()
            (drawn_line,) = axis.plot(second, mean, label=label)
            axis.fill_between(second, mean - 1.645 * std, mean + 1.645 * std, alpha=0.25, color=drawn_line.get_color())
        axis.plot(second, data["reading"][run, span, component], ".", color="gray", markersize=3, label="camera")
        axis.plot(second, data["state"][run, span, component], "k--", linewidth=1, label="truth")
        axis.set(ylabel=name, ylim=(-5, size + 5))
    axes[1].axhspan(*PILLAR, color="gray", alpha=0.15)
    axes[1].legend(ncols=4, fontsize="small", loc="upper right")
    for out in outs.values():
        if ("sensor", "visible") in out.keys(True, True):
            axes[3].plot(second, out["sensor", "visible"][run, span], label="p, from the picture")
            axes[3].plot(second, out["info", "visible"][run, span], label="q, with the reading")
    axes[3].set(xlabel="time, s", ylabel="does it see?", ylim=(-0.05, 1.05))
    axes[3].legend(fontsize="small")
    save(figure, file)


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    train, test = 100, 150
    if study.smoke:
        study = replace(study, camera_runs=1, filter_runs=4, test_runs=4, epochs=1, iterations=1, window=10, batch=2)
        train = 30
    torch.set_num_threads(1)
    sensor = fit_camera(runs(study.camera_runs, train, study.seed), study.epochs, study.seed)
    tuning = read(sensor, runs(study.filter_runs, train, study.seed + 1), study.seed + 10_000)
    data = read(sensor, runs(study.test_runs, test, study.seed + 2), study.seed + 20_000)
    rows, outs = [{"filter": "camera alone", "knows": "nothing", **scores(data["reading"], None, data)}], {}
    options = {"iterations": study.iterations, "window": study.window, "batch": study.batch, "seed": study.seed}
    for kind in KINDS:
        for knows, kinds in KNOWS.items():
            if kind not in kinds:
                continue
            began, heeds = time.process_time(), "visibility" in knows
            error = lasting_error(tuning, seen=heeds) if "errors last" in knows and not study.smoke else None
            filter = filter_of(kind, visibility=heeds, error=error)
            more = {"iterations": LSTM * study.iterations} if kind == "LSTM" else {}
            fit_filter(filter, tuning, labels=heeds and "no labels" not in knows, **{**options, **more})
            out = believed(filter, data, study.seed)
            mean, var = (out["belief", name][..., :2] for name in ("mean", "var"))
            rows.append(
                {"filter": kind, "knows": knows, **scores(mean, var, data), "seconds": time.process_time() - began}
            )
            if kind == "DEnKF" and knows in ("nothing", "visibility"):
                outs[f"DEnKF, knows {knows}"] = out
            print(
                {key: round(value, 2) if isinstance(value, float) else value for key, value in rows[-1].items()},
                flush=True,
            )
    if study.out is not None:
        study.out.mkdir(parents=True, exist_ok=True)
        COLUMNS.write(rows, study.out / "occlusion.csv")
        draw(outs, data, study.out / "occlusion.png")
    write_page(page(rows, study), None if study.out is None else study.out / "occlusion.md")
