"""The study: its options, its jobs, its table."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import pandas as pd

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.jobs import compute
from benchmarks.common.tables import head, line, report
from benchmarks.smoothing import against_dapper, ours, real
from benchmarks.smoothing.cases import CASES

ERRORS = ("rmse_filter", "rmse_smoother", "dapper_rmse_filter", "dapper_rmse_smoother")
COLUMNS = ("system", "method", "lag", "seed", *ERRORS)


@dataclass(frozen=True)
class Study:
    """Compares smoothers on Lorenz-63 and Lorenz-96 with DAPPER, if installed, on the same truth and readings.

    With --real: smoothers with the package's trained sensors, on the UR5 and, with --root, on KITTI.
    """

    out: Path = Path("runs/smoothing")
    seeds: int = 4
    cycles: int = 2000  # of which the first 64 (Lorenz-63) or 133 (Lorenz-96) are not scored
    processes: int = 1
    real: bool = False  # recordings instead of chaotic systems
    root: Path | None = None  # of --real: folder with KITTI's sequences and poses
    smoke: bool = False  # a few cycles: does it run?


def page(rows: Sequence[dict], study: Study) -> str:
    """Returns means over the seeds."""
    lines = [
        "# Smoothers on chaotic systems",
        "",
        "Root mean square errors of the means, over the components, averaged over the cycles; means over the seeds.",
        "",
        *head("system", "method", "lag", "members", "filter", "smoother", "DAPPER's", "DAPPER's smoother"),
    ]
    table = pd.DataFrame(rows, columns=COLUMNS)
    for case in CASES:
        lag = table["lag"].isna() if case.lag is None else table["lag"] == case.lag
        found = table.loc[lag & (table["system"] == case.system) & (table["method"] == case.method), list(ERRORS)]
        if found.empty:
            continue
        means, counts = found.mean(), found.count()
        cells = [case.system, case.method, "all" if case.lag is None else case.lag or "", case.ensemble_size]
        for key in ERRORS:
            partly = f" ({counts[key]} seeds)" if counts[key] < len(found) else ""
            cells.append(f"{means[key]:.3f}{partly}" if counts[key] else "")
        lines.append(line(*cells))
    said = f"; seeds 0 to {study.seeds - 1}, none left out; {study.cycles:,} cycles of\n"
    said += "  25 (Lorenz-63) and 15 (Lorenz-96) small steps of 0.01; double precision"
    return "\n".join([*lines, "", *made_by("smoothing", said)]) + "\n"


def main() -> None:
    """Runs the study; an interrupted one resumes."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, out=Path(tempfile.mkdtemp(prefix="smoothing-")), cycles=26, seeds=2)
    if study.real:
        rows = compute(real.jobs(study.root, study.out, study.smoke), study.processes, "smoothing")
        report(study.out, rows, real.page(rows), "smoothing_real", real.COLUMNS[:6], real.COLUMNS)
        return
    seeds, parts = list(range(study.seeds)), study.out / "parts"
    jobs: dict[Path, partial] = {
        parts / f"{case.name}.json": partial(ours.rows, case, seeds, study.cycles) for case in CASES
    }
    if against_dapper.installed() and not study.smoke:
        for case in CASES:
            for seed in seeds:
                file = parts / f"{case.name}-dapper-{seed}.json"
                jobs[file] = partial(against_dapper.rows, case, seed, study.cycles)
    rows = joined(compute(jobs, study.processes, "smoothing"))
    report(study.out, rows, page(rows, study), "smoothing", COLUMNS[:4], COLUMNS)


def joined(rows: Sequence[dict]) -> list[dict]:
    """Joins our row and DAPPER's row of each case and seed."""
    out: dict[tuple, dict] = {}
    for row in rows:
        key = (row["system"], row["method"], row.get("lag"), row["seed"])
        out.setdefault(key, {}).update(row)
    return list(out.values())
