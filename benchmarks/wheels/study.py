"""The study: its options, its filters, its table."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist

import torch
from tensordict import TensorDict

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import Columns, head, line, write_page
from benchmarks.wheels.task import DT, NAMES, ensemble_filter, gaussian_filter, recordings
from torch_denkf import Filter

LEVEL = 0.9  # of the intervals
SETTLED = 5.0  # s that are not scored
COLUMNS = Columns(
    names=("filter", "members", "threshold", *NAMES, "error_x", "error_y", "ms"),
    text=("filter",),
    whole=("members",),
    order=lambda row: (row["filter"], row.get("members", 0), row.get("threshold", 0.0)),
)


@dataclass(frozen=True)
class Study:
    """How many members does an ensemble with fast sensors need?"""

    out: Path | None = None  # folder for wheels.csv and wheels.md
    runs: int = 16
    seconds: float = 60.0  # of a run
    members: tuple[int, ...] = (16, 32, 64, 128, 512)
    thresholds: tuple[float, ...] = (2.0, 3.0, 4.0)  # of the significance; all of them with 64 members, 3 elsewhere
    seed: int = 0
    smoke: bool = False  # one short run: does it run?


@torch.no_grad()
def row(filter: Filter, data: TensorDict) -> dict[str, float]:
    """Share of the true states within the intervals, by component; errors of the place; milliseconds a step."""
    torch.manual_seed(0)
    began = time.process_time()
    out = filter.sequence(data.clone(), keep=[("belief", "mean"), ("belief", "var")])
    took, skip = time.process_time() - began, min(round(SETTLED / DT), data.shape[1] // 2)
    error = (out["belief", "mean"] - data["state"])[:, skip:]
    half = NormalDist().inv_cdf((1 + LEVEL) / 2) * out["belief", "var"][:, skip:].sqrt()
    held = (error.abs() <= half).float().mean((0, 1))
    x, y = error[..., :2].square().mean((0, 1)).sqrt().tolist()
    return {
        **dict(zip(NAMES, held.tolist(), strict=True)),
        "error_x": x,
        "error_y": y,
        "ms": 1e3 * took / data.shape[1],
    }


def page(rows: list[dict], study: Study) -> str:
    """The table."""
    lines = [
        "# A robot on wheels",
        "",
        f"Share of the true states within the {LEVEL:.0%} intervals, and root mean square error of the place: "
        f"{study.runs} runs of {study.seconds:g} s, without their first {SETTLED:g} s.",
        "",
        *head("filter", *NAMES, "x, m", "y, m", "ms a step"),
    ]
    for found in rows:
        cells = [f"{100 * found[name]:.0f} %" for name in NAMES]
        lines.append(
            line(label(found), *cells, *(f"{found[key]:.2f}" for key in ("error_x", "error_y")), f"{found['ms']:.1f}")
        )
    lines += ["", "Steps of all runs at once, one thread, processor time.", "", *made_by("wheels")]
    return "\n".join(lines) + "\n"


def label(found: dict) -> str:
    """The name of a row."""
    if "members" not in found:
        return found["filter"]
    threshold = f", threshold {found['threshold']:g}" if "threshold" in found else ""
    return f"{found['members']} members, {found['filter']}{threshold}"


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, runs=1, seconds=1.0, members=(16,), thresholds=(3.0,))
    torch.set_num_threads(1)
    data = recordings(study.runs, round(study.seconds / DT), study.seed)
    rows = [{"filter": "extended Kalman filter", **row(gaussian_filter(), data)}]
    for members in study.members:
        rows.append({"filter": "plain", "members": members, **row(ensemble_filter(members), data)})
        for threshold in study.thresholds if members == 64 else study.thresholds[len(study.thresholds) // 2 :][:1]:
            filter = ensemble_filter(members, localisation="significance", threshold=threshold)
            rows.append({"filter": "significance", "members": members, "threshold": threshold, **row(filter, data)})
        print(label(rows[-1]), flush=True)
    if study.out is not None:
        study.out.mkdir(parents=True, exist_ok=True)
        COLUMNS.write(rows, study.out / "wheels.csv")
    write_page(page(rows, study), None if study.out is None else study.out / "wheels.md")
