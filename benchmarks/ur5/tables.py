"""The table, as CSV and as Markdown."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

from benchmarks.ur5.evaluation import BLACKOUT, COLUMNS, NAMES
from benchmarks.ur5.readings import CONDITIONS

TEXT, WHOLE = ("filter", "sensor", "domain", "training", "condition"), ("ensemble_size", "seed", "demos")
FAIRNESS = (
    "All filters of a sensor start from the same sensor's weights and the same learned motion, and learn from the same "
    "windows of its readings with as many updates; each then trains its own copy of the sensor's head. Each has one "
    "number (a factor on the noise, or tempering of weights) chosen from the same seven values for the coverage on the "
    "same validation demos. 'sensor' is the mean of its samples, with J6 turned by half a turn where that is nearer to "
    "the truth; where nothing is seen its last reading stays."
)


def write_csv(rows: Sequence[dict], file: Path) -> None:
    """All rows, one for each filter, sensor, domain, training, condition, ensemble size and seed."""
    rows = sorted(
        rows, key=lambda row: tuple(row[key] for key in ("domain", "sensor", "training", "filter")) + _place(row)
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: f"{value:.5g}" if isinstance(value, float) else value for key, value in row.items()})


def _place(row: dict) -> tuple:
    return CONDITIONS.index(row["condition"]), row["ensemble_size"], row["seed"]


def read_csv(file: Path) -> list[dict]:
    """Rows as :func:`write_csv` wrote them; what is empty is left out."""
    with file.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    return [
        {k: v if k in TEXT else int(v) if k in WHOLE else float(v) for k, v in row.items() if v != ""} for row in rows
    ]


def pick(rows: Iterable[dict], **wanted) -> list[dict]:
    """Rows with these entries."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def over_seeds(rows: Iterable[dict], column: str) -> float | None:
    """Median over the seeds."""
    values = [row[column] for row in rows if column in row]
    return median(values) if values else None


def markdown(rows: Sequence[dict], header: str) -> str:
    """A table for each domain and training, one of failing cameras, and one of ensemble sizes."""
    seeds = sorted({row["seed"] for row in rows})
    lines = [header, "", FAIRNESS, "", f"Medians over {len(seeds)} seed(s)."]
    main = [row for row in rows if not _resized(row, rows)]
    for domain in sorted({row["domain"] for row in main}, reverse=True):
        lines += ["", f"**{domain}**", "", "| trained | sensor | filter | " + " | ".join(CONDITIONS) + " | J1 to J7 |"]
        lines.append("|---|---|---|" + "---|" * (len(CONDITIONS) + 1))
        here = pick(main, domain=domain)
        for key in sorted({_method(row) for row in here}, key=_order(here)):
            own = [row for row in here if _method(row) == key]
            cells = [_cell(pick(own, condition=condition)) for condition in CONDITIONS]
            clean = pick(own, condition="clean")
            joints = ", ".join(f"{over_seeds(clean, f'J{i}_deg'):.1f}" for i in range(1, 8)) if clean else ""
            lines.append(f"| {key[0]} | {key[1]} | {key[2]} | {' | '.join(cells)} | {joints} |")
    lines += ["", "Cells: joints deg / end effector cm / share of the true joints in the 90 % intervals.", ""]
    return "\n".join([*lines, *_blackouts(main), "", *_sizes(rows)]) + "\n"


def _method(row: dict) -> tuple[str, str, str]:
    return row["training"], row["sensor"], row["filter"]


def _order(rows: Sequence[dict]):
    def key(method: tuple[str, str, str]) -> tuple:
        own = [row for row in rows if _method(row) == method]
        return method[0], method[1], method[2] != "sensor", over_seeds(pick(own, condition="clean"), "joint_mae_deg")

    return key


def _cell(rows: Sequence[dict]) -> str:
    joints, place, covered = (over_seeds(rows, key) for key in ("joint_mae_deg", "ee_mae_cm", "coverage90"))
    return "" if joints is None else f"{joints:.2f} / {place:.2f} / {100 * covered:.0f} %"


def _resized(row: dict, rows: Sequence[dict]) -> bool:
    """Whether a row is one of the ensemble sizes that is not the filter's own: those have clean rows alone."""
    keys = [key for key in NAMES if key != "condition"]
    return row["filter"] != "sensor" and not any(
        other["condition"] == "black20" and all(other[key] == row[key] for key in keys) for other in rows
    )


def _blackouts(rows: Sequence[dict]) -> list[str]:
    lines = [
        "The camera black for 20 frames: error of the joints in these frames, and the mean standard deviation of the "
        "joints before, in the last of them, and 15 steps after, deg",
        "",
        "| domain | trained | sensor | filter | error | before | last black | after |",
        "|---|---|---|---|---|---|---|---|",
    ]
    chosen = [row for row in pick(rows, condition="black20") if BLACKOUT[0] in row]
    for key in sorted({(row["domain"], *_method(row)) for row in chosen}, reverse=True):
        own = [row for row in chosen if (row["domain"], *_method(row)) == key]
        cells = [f"{over_seeds(own, column):.2f}" for column in BLACKOUT]
        lines.append(f"| {' | '.join(key)} | {' | '.join(cells)} |")
    return lines


def _sizes(rows: Sequence[dict]) -> list[str]:
    resized = [row for row in rows if _resized(row, rows)]
    if not resized:
        return []
    first = resized[0]
    same = {key: first[key] for key in ("filter", "sensor", "domain", "training")}
    own = pick(rows, condition="clean", **same)
    lines = [
        f"Size of the ensemble, {first['filter']}, clean",
        "",
        "| members | CRPS, validation demos | joints deg | end effector cm | 90 % hold | ms |",
    ]
    lines.append("|---|---|---|---|---|---|")
    for size in sorted({row["ensemble_size"] for row in own}):
        at = pick(own, ensemble_size=size)
        values = [over_seeds(at, key) for key in ("joint_mae_deg", "ee_mae_cm", "coverage90", "ms_per_step")]
        crps = over_seeds(at, "validation_crps")
        chosen_by = "" if crps is None else f"{crps:.3f}"
        lines.append(
            f"| {size} | {chosen_by} | {values[0]:.2f} | {values[1]:.3f} | {100 * values[2]:.0f} % | {values[3]:.2f} |"
        )
    return lines
