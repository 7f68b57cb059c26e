"""The table of all folds: its columns, and its Markdown."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from statistics import mean, median, stdev

from benchmarks.common.tables import Columns, head, line, pick
from benchmarks.kitti.streams import CONDITIONS

IDENTITY = ("filter", "sensor", "drive", "condition", "window", "seed")
_ERRORS = (
    "translation_m_per_m",
    "spread_m_per_m",
    "of_dead_reckoning",
    "rotation_deg_per_m",
    "coverage90",
    "coverage90_v",
    "coverage90_theta_dot",
)
_VELOCITY = ("rmse_v_m_per_s", "mae_v_m_per_s", "rmse_theta_dot_deg_per_s", "mae_theta_dot_deg_per_s")
_BELIEF = ("crps_v_m_per_s", "crps_theta_dot_deg_per_s", "nll", "nees", "spread_skill")
_OTHERS = ("pathlength_m_per_m", "pathlength_deg_per_m", "devkit_t_rel_percent", "devkit_r_rel_deg_per_m", "blind")
_COST = ("parameters", "ms_per_step")
COLUMNS = Columns(
    (*IDENTITY, *_ERRORS, *_VELOCITY, *_BELIEF, *_OTHERS, *_COST),
    text=IDENTITY[:4],
    whole=IDENTITY[4:],
    order=lambda row: tuple(row[key] for key in IDENTITY),
)
FAIRNESS = (
    "In each fold and seed all filters start from the same sensor's weights and learn from the same windows of its "
    "readings, with as many updates and steps back-propagated, at the same rate; each then trains its own copy of the "
    "sensor end to end for as many updates. Each has one number (inflation, or tempering of particle weights) chosen "
    "from the same values by the CRPS of the velocities times the path's error on the same validation readings. "
    "Where the speeds that the sensor reads are off by one factor on all drives that it has not seen (t test, 5 %), "
    "all filters may know that factor, if validation says so; dead reckoning does not."
)
TITLES = {"dead_reckoning": "dead reckoning", "floor": "floor: true v and theta_dot"}
HEADLINES = ("m/m", "of its sensor", "deg/m", "devkit", "CRPS v", "CRPS theta_dot", "coverage v", "coverage theta_dot")
END_POINT = ("translation_m_per_m", "rotation_deg_per_m")
PATH_LENGTH = ("pathlength_m_per_m", "pathlength_deg_per_m")


def by_drive(rows: Iterable[dict], column: str) -> dict[str, float]:
    """Median over the seeds of each drive; cameras of one drive are averaged first."""
    values: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        value = row.get(column, math.nan)
        if value == value:
            values[drive_of(row)][row["seed"]].append(value)
    return {drive: median(mean(cameras) for cameras in seeds.values()) for drive, seeds in sorted(values.items())}


def drive_of(row: dict) -> str:
    """The drive without its camera."""
    return row["drive"].split("/")[0]


def summary(rows: Iterable[dict], column: str) -> str:
    """Mean over the drives and its standard error."""
    values = list(by_drive(rows, column).values())
    if not values:
        return ""
    error = f" ± {stdev(values) / math.sqrt(len(values)):.3f}" if len(values) > 1 else ""
    return f"{mean(values):.3f}{error}"


def plain(rows: Iterable[dict], column: str, factor: float = 1.0) -> str:
    """Mean over the drives."""
    values = by_drive(rows, column).values()
    return f"{factor * mean(values):.3g}" if values else ""


def markdown(rows: Sequence[dict], header: str) -> str:
    """Means over drives for each condition, errors by window, and each drive's own."""
    seeds = {row["seed"] for row in rows}
    methods = sorted({(row["filter"], row["sensor"]) for row in rows if row["filter"] != "floor"}, key=_order)
    window = 100 if any(row["window"] == 100 for row in rows) else max(row["window"] for row in rows)
    floor = [{**row, "sensor": "truth"} for row in pick(rows, filter="floor", sensor=methods[0][1])]
    lines = [
        header,
        *(["", FAIRNESS] if len({name for name, _ in methods} - {"dead_reckoning"}) > 1 else []),
        "",
        f"End point error over {window} steps: mean over the drives that are long enough ± its standard error; each "
        f"drive's figure is the median of {len(seeds)} seed(s), and the mean of several runs of a filter that draws "
        "random numbers. Of its sensor: m/m over that of dead reckoning by the filter's own sensor. Devkit: KITTI's "
        "metric over 100 to 800 m, planar, % and deg/100 m, of the drives that are so long. CRPS of v in m/s, of "
        "theta_dot in deg/s; dead reckoning's is its mean absolute error. Coverage: share of true v and theta_dot "
        "inside the filter's 90 % intervals.",
        "",
        *head("condition", "filter", "sensor", *HEADLINES),
    ]
    shown = [(condition, *method) for condition in CONDITIONS for method in methods]
    for condition, name, sensor in [*shown, ("clean", "floor", "truth")]:
        own = pick([*rows, *floor], condition=condition, window=window, filter=name, sensor=sensor)
        devkit = [plain(own, "devkit_t_rel_percent"), plain(own, "devkit_r_rel_deg_per_m", 100)]
        cells = [summary(own, END_POINT[0]), plain(own, "of_dead_reckoning"), summary(own, END_POINT[1])]
        cells.append(", ".join(filter(None, devkit)))
        cells += [plain(own, key) for key in ("crps_v_m_per_s", "crps_theta_dot_deg_per_s")]
        cells += [summary(own, key) for key in ("coverage90_v", "coverage90_theta_dot")]
        lines.append(line(condition, _title(rows, name, len(seeds)), sensor, *cells))
    lines += ["", *_by_window([*rows, *floor], [*methods, ("floor", "truth")])]
    lines += ["", *_by_drive(rows, methods, window), "", *_reference(rows, methods, window)]
    return "\n".join(lines) + "\n"


def _title(rows: Sequence[dict], name: str, seeds: int) -> str:
    """A filter's, with its number of seeds where others have more."""
    own = len({row["seed"] for row in rows if row["filter"] == name})
    return TITLES.get(name, name) + (f" (at most {own} of {seeds} seeds)" if own < seeds else "")


def _order(method: tuple[str, str]) -> tuple:
    return method[1] != "flow", method[0] == "dead_reckoning", method[0]


def _pair(rows: Sequence[dict], columns: Sequence[str] = END_POINT) -> str:
    """Means over the drives of an error of translation and one of rotation."""
    values = [list(by_drive(rows, column).values()) for column in columns]
    return ", ".join(f"{mean(each):.3f}" if each else "-" for each in values)


def _by_window(rows: Sequence[dict], methods: Sequence[tuple[str, str]]) -> list[str]:
    windows = sorted({row["window"] for row in rows})
    lines = ["Errors by length, clean: m/m, deg/m", "", *head("filter", "sensor", *windows)]
    for name, sensor in methods:
        chosen = pick(rows, filter=name, sensor=sensor, condition="clean")
        lines.append(line(TITLES.get(name, name), sensor, *(_pair(pick(chosen, window=each)) for each in windows)))
    return lines


def _by_drive(rows: Sequence[dict], methods: Sequence[tuple[str, str]], window: int) -> list[str]:
    titles = [f"{TITLES.get(name, name)}, {sensor}" for name, sensor in methods]
    lines = [f"Each drive, clean, {window} steps (50 where it is shorter): m/m, deg/m", "", *head("drive", *titles)]
    clean = pick(rows, condition="clean")
    for drive in sorted({drive_of(row) for row in rows}):
        own = [[row for row in pick(clean, filter=f, sensor=s) if drive_of(row) == drive] for f, s in methods]
        lines.append(line(drive, *(_pair(pick(each, window=window) or pick(each, window=50)) for each in own)))
    return lines


def _reference(rows: Sequence[dict], methods: Sequence[tuple[str, str]], window: int) -> list[str]:
    """The paper's Tables II and III: both metrics, its conditions; and what a filter costs."""
    conditions = ("clean", "salt_and_pepper", "blur", "missing")
    lines = [
        f"Both metrics over {window} steps, end point / path length as in the reference script: m/m, deg/m; parameters "
        "and time of a step of one drive on one thread, both without the sensor",
        "",
        *head("filter", "sensor", *conditions, "parameters", "ms"),
    ]
    for name, sensor in methods:
        own = pick(rows, filter=name, sensor=sensor, window=window)
        cells = [f"{_pair(at)} / {_pair(at, PATH_LENGTH)}" for at in (pick(own, condition=c) for c in conditions)]
        for column, digits in (("parameters", 0), ("ms_per_step", 2)):
            values = list(by_drive(own, column).values())
            cells.append(f"{median(values):.{digits}f}" if values else "")
        lines.append(line(TITLES.get(name, name), sensor, *cells))
    return lines
