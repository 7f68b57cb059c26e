"""The study: its options, its jobs side by side, its table."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.jobs import compute, read_rows
from benchmarks.common.tables import Columns, head, line, pick, write_page
from benchmarks.smoothing import against_dapper, ours, real
from benchmarks.smoothing.cases import CASES

COLUMNS = Columns(
    names=(
        "system",
        "method",
        "lag",
        "seed",
        "rmse_filter",
        "rmse_smoother",
        "dapper_rmse_filter",
        "dapper_rmse_smoother",
    ),
    text=("system", "method"),
    whole=("lag", "seed"),
    order=lambda row: (row["system"], row["method"], row.get("lag", 1000), row["seed"]),
)


@dataclass(frozen=True)
class Study:
    """Smoothers on Lorenz-63 and Lorenz-96, and DAPPER on the same truth and readings where it is installed.

    With --real: smoothers behind the package's trained sensors, on the UR5 and, with --root, on KITTI.
    """

    out: Path = Path("runs/smoothing")
    seeds: int = 4
    cycles: int = 2000  # of which the first 64 (Lorenz-63) or 133 (Lorenz-96) do not count
    processes: int = 1
    real: bool = False  # recordings in the place of chaotic systems
    root: Path | None = None  # of --real: folder with KITTI's sequences and poses
    smoke: bool = False  # a few cycles: does it run?


def page(rows: Sequence[dict], study: Study) -> str:
    """Means over the seeds, beside the targets."""
    titles = (
        "system",
        "method",
        "lag",
        "members",
        "filter",
        "smoother",
        "DAPPER's",
        "DAPPER's smoother",
        "target",
        "met",
    )
    lines = [
        "# Smoothers on chaotic systems",
        "",
        "Root mean square errors of the means, over the components, averaged over the cycles; means over the seeds.",
        "The target is on the smoother's error or on the filter's, as it says.",
        "",
        *head(*titles),
    ]
    for case in CASES:
        found = pick([{"lag": None, **row} for row in rows], **{"lag": None, **case.labels()})
        if not found:
            continue

        def mean(key: str, found: Sequence[dict] = found) -> float | None:
            values = [row[key] for row in found if key in row and row[key] == row[key]]
            return fmean(values) if values else None

        scored = mean(f"rmse_{case.scored}")
        assert scored is not None
        errors = [mean(key) for key in COLUMNS.names[4:]]
        cells = [case.system, case.method, "all" if case.lag is None else case.lag or "", case.ensemble_size]
        counts = [sum(key in row for row in found) for key in COLUMNS.names[4:]]
        partly = [f" ({count} seeds)" if 0 < count < len(found) else "" for count in counts]
        cells += ["" if error is None else f"{error:.3f}{seeds}" for error, seeds in zip(errors, partly, strict=True)]
        lines.append(line(*cells, f"{case.scored} {case.target}", "yes" if scored <= case.target else "no"))
    said = f"; seeds 0 to {study.seeds - 1}, none left out; {study.cycles:,} cycles of\n"
    said += "  25 (Lorenz-63) and 15 (Lorenz-96) small steps of 0.01; double precision"
    return "\n".join([*lines, "", *made_by("smoothing", said)]) + "\n"


def main() -> None:
    """Runs the study; one that was broken off goes on."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, out=Path(tempfile.mkdtemp(prefix="smoothing-")), cycles=26, seeds=2)
    if study.real:
        run_real(study)
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
    COLUMNS.write(rows, study.out / "smoothing.csv")
    write_page(page(rows, study), study.out / "smoothing.md")


def run_real(study: Study) -> None:
    """The part on recordings."""
    jobs = real.jobs(study.root, study.out, study.smoke)
    compute(jobs, study.processes, "smoothing")
    rows = read_rows(jobs)
    real.COLUMNS.write(rows, study.out / "smoothing_real.csv")
    write_page(real.page(rows), study.out / "smoothing_real.md")


def joined(rows: Sequence[dict]) -> list[dict]:
    """Ours and DAPPER's of one case and seed, in one row."""
    out: dict[tuple, dict] = {}
    for row in rows:
        key = (row["system"], row["method"], row.get("lag"), row["seed"])
        out.setdefault(key, {}).update(row)
    return list(out.values())
