"""The table of all folds: its columns, and its Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import pandas as pd

from benchmarks.common.tables import head, line
from benchmarks.kitti.streams import CONDITIONS

IDENTITY = ("filter", "sensor", "drive", "condition", "window", "seed")
_ERRORS = (
    *("translation_m_per_m", "spread_m_per_m", "of_dead_reckoning", "rotation_deg_per_m"),
    *("coverage90", "coverage90_v", "coverage90_theta_dot"),
)
_VELOCITY = ("rmse_v_m_per_s", "mae_v_m_per_s", "rmse_theta_dot_deg_per_s", "mae_theta_dot_deg_per_s")
_BELIEF = ("crps_v_m_per_s", "crps_theta_dot_deg_per_s", "nll", "nees", "spread_skill")
_OTHERS = ("pathlength_m_per_m", "pathlength_deg_per_m", "devkit_t_rel_percent", "devkit_r_rel_deg_per_m", "blind")
_COST = ("parameters", "ms_per_step")
COLUMNS = (*IDENTITY, *_ERRORS, *_VELOCITY, *_BELIEF, *_OTHERS, *_COST)
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
END_POINT = ["translation_m_per_m", "rotation_deg_per_m"]
PATH_LENGTH = ["pathlength_m_per_m", "pathlength_deg_per_m"]
FLOOR = ("floor", "truth")  # a filter and its sensor


def by_drive(rows: Iterable[dict]) -> pd.DataFrame:
    """Returns scores by filter, sensor, condition, window and drive: means of its cameras, then medians of seeds."""
    frame = pd.DataFrame(rows, columns=COLUMNS)
    frame["drive"] = frame["drive"].str.split("/").str[0]
    keys = ["filter", "sensor", "condition", "window", "drive"]
    return frame.groupby([*keys, "seed"]).mean().groupby(keys).median()


class Drives:
    """Looks up the scores of the drives, a row for each; empty if there are none."""

    def __init__(self, rows: Sequence[dict]):
        self.table = by_drive(rows)

    def __call__(self, method: tuple[str, str], condition: str, window: int) -> pd.DataFrame:
        key = (*method, condition, window)
        return self.table.loc[key] if key in self.table.index else self.table.iloc[:0].droplevel([0, 1, 2, 3])


def summary(values: pd.Series) -> str:
    """Returns the mean over the drives and its standard error."""
    values = values.dropna()
    error = f" ± {values.sem():.3f}" if len(values) > 1 else ""
    return f"{values.mean():.3f}{error}" if len(values) else ""


def plain(values: pd.Series, layout: str = "{:.3g}", factor: float = 1.0) -> str:
    """Returns the mean over the drives."""
    return layout.format(factor * values.mean()) if values.notna().any() else ""


def markdown(rows: Sequence[dict], header: str) -> str:
    """Returns the tables: means over drives for each condition, errors by window, and errors of each drive."""
    methods = sorted({(row["filter"], row["sensor"]) for row in rows if row["filter"] != "floor"}, key=_order)
    windows = sorted({row["window"] for row in rows})
    window = 100 if 100 in windows else windows[-1]
    floor = [{**row, "sensor": "truth"} for row in rows if (row["filter"], row["sensor"]) == ("floor", methods[0][1])]
    drives, seeds = Drives([*rows, *floor]), {row["seed"] for row in rows}
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
    for condition, method in [*((each, method) for each in CONDITIONS for method in methods), ("clean", FLOOR)]:
        own = drives(method, condition, window)
        devkit = plain(own["devkit_t_rel_percent"]), plain(own["devkit_r_rel_deg_per_m"], factor=100)
        translation, rotation = (summary(own[key]) for key in END_POINT)
        cells = [translation, plain(own["of_dead_reckoning"]), rotation, ", ".join(filter(None, devkit))]
        cells += [plain(own[key]) for key in ("crps_v_m_per_s", "crps_theta_dot_deg_per_s")]
        cells += [summary(own[key]) for key in ("coverage90_v", "coverage90_theta_dot")]
        lines.append(line(condition, _title(rows, method[0], len(seeds)), method[1], *cells))
    lines += ["", "Errors by length, clean: m/m, deg/m", "", *head("filter", "sensor", *windows)]
    for method in [*methods, FLOOR]:
        lines.append(line(*_names(method), *(_pair(drives(method, "clean", each)) for each in windows)))
    lines += ["", f"Each drive, clean, {window} steps (50 where it is shorter): m/m, deg/m", ""]
    lines += head("drive", *(", ".join(_names(method)) for method in methods))
    own = [(drives(method, "clean", window), drives(method, "clean", 50)) for method in methods]
    for drive in sorted(set(drives.table.index.get_level_values("drive"))):
        found = [long.loc[[drive]] if drive in long.index else short.filter([drive], axis=0) for long, short in own]
        lines.append(line(drive, *map(_pair, found)))
    return "\n".join([*lines, "", *_reference(drives, methods, window)]) + "\n"


def _title(rows: Sequence[dict], name: str, seeds: int) -> str:
    """Returns a filter's title, with its number of seeds if others have more."""
    own = len({row["seed"] for row in rows if row["filter"] == name})
    return TITLES.get(name, name) + (f" (at most {own} of {seeds} seeds)" if own < seeds else "")


def _names(method: tuple[str, str]) -> tuple[str, str]:
    return TITLES.get(method[0], method[0]), method[1]


def _order(method: tuple[str, str]) -> tuple:
    return method[1] != "flow", method[0] == "dead_reckoning", method[0]


def _pair(drives: pd.DataFrame, columns: Sequence[str] = END_POINT) -> str:
    """Returns means over the drives of an error of translation and one of rotation."""
    return ", ".join(plain(drives[column], "{:.3f}") or "-" for column in columns)


def _reference(drives: Drives, methods: Sequence[tuple[str, str]], window: int) -> list[str]:
    """Returns the paper's Tables II and III, with both metrics and its conditions, and the cost of each filter."""
    conditions = ("clean", "salt_and_pepper", "blur", "missing")
    lines = [
        f"Both metrics over {window} steps, end point / path length as in the reference script: m/m, deg/m; parameters "
        "and time of a step of one drive on one thread, both without the sensor",
        "",
        *head("filter", "sensor", *conditions, "parameters", "ms"),
    ]
    for method in methods:
        found = [drives(method, condition, window) for condition in conditions]
        cost = found[0][list(_COST)].median().map("{:.2f}".format).replace("nan", "")
        times = cost["parameters"].removesuffix(".00"), cost["ms_per_step"]
        lines.append(line(*_names(method), *(f"{_pair(at)} / {_pair(at, PATH_LENGTH)}" for at in found), *times))
    return lines
