"""The table of all folds, as CSV and as Markdown."""

from __future__ import annotations

import csv
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import mean, median, stdev

from benchmarks.kitti.evaluation import COLUMNS
from benchmarks.kitti.streams import CONDITIONS

FAIRNESS = (
    "In each fold and seed all filters start from the same sensor's weights and learn from the same windows of its "
    "readings, with as many updates and steps back-propagated, at the same rate; each then trains its own copy of the "
    "sensor end to end for as many updates. Each has one number (inflation, or tempering of particle weights) chosen "
    "from the same seven values for the coverage on the same validation readings."
)
TITLES = {"dead_reckoning": "dead reckoning", "floor": "floor: true v and theta_dot"}


def write_csv(rows: Sequence[dict], file: Path) -> None:
    """All rows, one for each filter, sensor, drive, condition, window and seed."""
    rows = sorted(rows, key=lambda row: (*(row[key] for key in COLUMNS[:4]), row["window"], row["seed"]))
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: f"{v:.5g}" if isinstance(v, float) else v for key, v in row.items() if v == v})


def read_csv(file: Path) -> list[dict]:
    """Rows as :func:`write_csv` wrote them."""
    with file.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    text = {"filter", "sensor", "drive", "condition"}
    whole = {"window", "seed"}
    return [
        {k: v if k in text else int(v) if k in whole else float(v or "nan") for k, v in row.items()} for row in rows
    ]


def by_drive(rows: Iterable[dict], column: str) -> dict[str, float]:
    """Median over the seeds of each drive; cameras of one drive are averaged first."""
    values: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        value = row.get(column, math.nan)
        if value == value:
            values[row["drive"].split("/")[0]][row["seed"]].append(value)
    return {drive: median(mean(cameras) for cameras in seeds.values()) for drive, seeds in sorted(values.items())}


def summary(rows: Iterable[dict], column: str) -> str:
    """Mean over the drives and its standard error."""
    values = list(by_drive(rows, column).values())
    if not values:
        return ""
    error = f" ± {stdev(values) / math.sqrt(len(values)):.3f}" if len(values) > 1 else ""
    return f"{mean(values):.3f}{error}"


def pick(rows: Sequence[dict], **wanted) -> list[dict]:
    """Rows with these entries."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def markdown(rows: Sequence[dict], header: str) -> str:
    """Means over drives for each condition, errors by window, and each drive's own."""
    seeds, drives = sorted({row["seed"] for row in rows}), sorted({row["drive"].split("/")[0] for row in rows})
    methods = sorted({(row["filter"], row["sensor"]) for row in rows if row["filter"] != "floor"}, key=_order)
    window = 100 if any(row["window"] == 100 for row in rows) else max(row["window"] for row in rows)
    lines = [
        header,
        "",
        f"End point error over {window} steps: mean over the drives that are long enough ± its standard error; each "
        f"drive's figure is the median of {len(seeds)} seed(s). Coverage: share of true v and theta_dot inside the "
        "filter's 90 % intervals.",
        "",
        "| condition | filter | sensor | m/m | deg/m | coverage v | coverage theta_dot |",
        "|---|---|---|---|---|---|---|",
    ]
    for condition in CONDITIONS:
        chosen = [(*method, pick(rows, condition=condition, window=window)) for method in methods]
        lines += [_line(condition, *method) for method in chosen]
    filters = {name for name, _ in methods} - {"dead_reckoning"}
    if len(filters) > 1:
        lines[1:1] = ["", FAIRNESS]
    first = methods[0][1]
    floor = pick(rows, filter="floor", sensor=first, window=window)
    lines.append(_line("clean", "floor", "truth", [{**row, "sensor": "truth"} for row in floor]))
    lines += ["", *_by_window(rows, methods, first), "", *_by_drive(rows, methods, drives, window)]
    lines += ["", *_reference(rows, methods, window)]
    return "\n".join(lines) + "\n"


def _reference(rows: Sequence[dict], methods: Sequence[tuple[str, str]], window: int) -> list[str]:
    """The paper's Tables II and III: both metrics, its conditions; and what a filter costs."""
    conditions = ("clean", "salt_and_pepper", "blur", "missing")
    lines = [
        f"Both metrics over {window} steps, end point / path length as in the reference script: m/m, deg/m; parameters "
        "and time of a step of one drive on one thread, both without the sensor",
        "",
        "| filter | sensor | " + " | ".join(conditions) + " | parameters | ms |",
        "|---|---|" + "---|" * (len(conditions) + 2),
    ]
    for name, sensor in methods:
        own = pick(rows, filter=name, sensor=sensor, window=window)
        cells = []
        for condition in conditions:
            at = pick(own, condition=condition)
            end = f"{_mean(at, 'translation_m_per_m')}, {_mean(at, 'rotation_deg_per_m')}"
            cells.append(f"{end} / {_mean(at, 'pathlength_m_per_m')}, {_mean(at, 'pathlength_deg_per_m')}")
        for column, digits in (("parameters", 0), ("ms_per_step", 2)):
            values = list(by_drive(own, column).values())
            cells.append(f"{median(values):.{digits}f}" if values else "")
        lines.append(f"| {TITLES.get(name, name)} | {sensor} | {' | '.join(cells)} |")
    return lines


def _order(method: tuple[str, str]) -> tuple:
    return method[1] != "flow", method[0] == "dead_reckoning", method[0]


def _line(condition: str, name: str, sensor: str, rows: Sequence[dict]) -> str:
    rows = pick(rows, filter=name, sensor=sensor)
    cells = [summary(rows, key) for key in ("translation_m_per_m", "rotation_deg_per_m")]
    cells += [summary(rows, key) for key in ("coverage90_v", "coverage90_theta_dot")]
    return f"| {condition} | {TITLES.get(name, name)} | {sensor} | " + " | ".join(cells) + " |"


def _by_window(rows: Sequence[dict], methods: Sequence[tuple[str, str]], first: str) -> list[str]:
    windows = sorted({row["window"] for row in rows})
    lines = ["Errors by length, clean: m/m, deg/m", "", "| filter | sensor | " + " | ".join(map(str, windows)) + " |"]
    lines.append("|---|---|" + "---|" * len(windows))
    for name, sensor in [*methods, ("floor", first)]:
        chosen = pick(rows, filter=name, sensor=sensor, condition="clean")
        cells = []
        for window in windows:
            at = pick(chosen, window=window)
            cells.append(f"{_mean(at, 'translation_m_per_m')}, {_mean(at, 'rotation_deg_per_m')}")
        lines.append(f"| {TITLES.get(name, name)} | {sensor if name != 'floor' else 'truth'} | {' | '.join(cells)} |")
    return lines


def _mean(rows: Sequence[dict], column: str) -> str:
    values = list(by_drive(rows, column).values())
    return f"{mean(values):.3f}" if values else "-"


def _by_drive(rows: Sequence[dict], methods: Sequence, drives: Sequence[str], window: int) -> list[str]:
    titles = " | ".join(f"{TITLES.get(name, name)}, {sensor}" for name, sensor in methods)
    lines = [f"Each drive, clean, {window} steps (50 where it is shorter): m/m, deg/m", "", f"| drive | {titles} |"]
    lines.append("|---|" + "---|" * len(methods))
    for drive in drives:
        cells: list[str] = []
        for name, sensor in methods:
            own = [r for r in pick(rows, filter=name, sensor=sensor, condition="clean") if _of(r, drive)]
            at = pick(own, window=window) or pick(own, window=50)
            cells.append(f"{_mean(at, 'translation_m_per_m')}, {_mean(at, 'rotation_deg_per_m')}")
        lines.append(f"| {drive} | {' | '.join(cells)} |")
    return lines


def _of(row: dict, drive: str) -> bool:
    return row["drive"].split("/")[0] == drive
