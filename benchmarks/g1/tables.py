"""The table: its columns, and its Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.common.tables import Columns, average, covered, grid, pick
from benchmarks.g1.baselines import Baselines
from benchmarks.g1.readings import CONDITIONS
from benchmarks.g1.recordings import NAMES

KEYS = ("filter", "condition", "seed")
ANGLES = tuple(f"{name}_deg" for name in NAMES)
COVERED = tuple(f"{name}_coverage90" for name in NAMES)
BLACKOUT = ("blackout_mae", "std_before", "std_blind", "std_after")
_SCORES = ("joint_mae_deg", "crps", "coverage90", *ANGLES, *COVERED, *BLACKOUT, "validation_crps")
COLUMNS = Columns(
    (*KEYS, *_SCORES, "parameters", "ms_per_step", "episodes"),
    text=KEYS[:2],
    whole=("seed", "parameters", "episodes"),
    order=lambda row: (row["filter"], CONDITIONS.index(row["condition"]), row["seed"]),
)
FAIRNESS = (
    "All filters of a seed read the same sensor, begin with the same learned motion, and learn from the same windows "
    "with as many updates (the LSTM, which knows no motion, with six times as many). Each has one number (a factor on "
    "the noise, or tempering of weights) chosen from the same seven values for the coverage on the same validation "
    "episodes, over all conditions. `sensor` reads every picture, repeats too, and knows the mean pose alone where "
    "none arrives; `held` is the sensor with a zero-order hold."
)


def markdown(rows: Sequence[dict], header: str) -> str:
    """A table of conditions, one of the joints, and one of black frames."""
    seeds = len({row["seed"] for row in rows})
    over = f"Means over {seeds} seed(s)" + (", ± the standard deviation over them." if seeds > 2 else ".")
    clean = pick(rows, condition="clean")
    ranked = sorted(rows, key=lambda row: (row["filter"] not in Baselines.names, _clean_error(clean, row["filter"])))
    scores = {name: lambda own, name=name: _cell(pick(own, condition=name)) for name in CONDITIONS}
    scores["CRPS, clean"] = lambda own: average(pick(own, condition="clean"), "crps", "{:.3f}", deviation=True)
    scores["ms"] = lambda own: average(pick(own, condition="clean"), "ms_per_step", deviation=True)
    joints = {
        name.replace("_", " "): lambda own, name=name: _cell(own, f"{name}_deg", f"{name}_coverage90") for name in NAMES
    }
    titles = ("error", "standard deviation before", "last black", "after")
    dark = {title: lambda own, name=name: average(own, name) for title, name in zip(titles, BLACKOUT, strict=True)}
    black = [row for row in ranked if BLACKOUT[0] in row]
    lines = [header, "", FAIRNESS, "", over, "", "Mean absolute error, degrees / coverage of the 90 % intervals", ""]
    lines += [*grid(ranked, ("filter",), scores), "", "By joint, clean", ""]
    lines += [*grid(pick(ranked, condition="clean"), ("filter",), joints), "", "The camera black for 20 frames", ""]
    return "\n".join([*lines, *grid(black, ("filter", "condition"), dark)]) + "\n"


def _clean_error(clean: Sequence[dict], name: str) -> float:
    return float(average(pick(clean, filter=name), "joint_mae_deg", "{}") or 0)


def _cell(rows: Sequence[dict], error: str = "joint_mae_deg", coverage: str = "coverage90") -> str:
    return f"{average(rows, error)} / {covered(rows, coverage)}" if rows else ""
