"""The table: its columns, and its Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import mean, stdev

from benchmarks.common.tables import Columns, head, line, pick
from benchmarks.g1.baselines import Baselines
from benchmarks.g1.readings import CONDITIONS
from benchmarks.g1.recordings import JOINTS, NAMES

KEYS = ("filter", "sensor", "state", "condition", "seed")
ANGLES = tuple(f"{name}_deg" for name in NAMES)
COVERED = tuple(f"{name}_coverage90" for name in NAMES)
BLACKOUT = ("blackout_mae", "std_before", "std_blind", "std_after")
_SCORES = ("joint_mae_deg", "crps", "coverage90", *ANGLES, *COVERED, *BLACKOUT, "validation_crps")
COLUMNS = Columns(
    (*KEYS, *_SCORES, "inflation", "parameters", "ms_per_step", "episodes"),
    text=KEYS[:4],
    whole=("seed", "parameters", "episodes"),
    order=lambda row: (
        *(row[key] for key in ("state", "sensor", "filter")),
        CONDITIONS.index(row["condition"]),
        row["seed"],
    ),
)
FAIRNESS = (
    "All filters of a seed read the same sensor, begin with the same learned motion, and learn from the same windows "
    "with as many updates. Each has one number (a factor on the noise, or tempering of weights) chosen from the same "
    "nine values for the coverage on the same validation episodes, over all conditions. `sensor` knows the mean pose "
    "alone where it sees nothing; `held` holds its last reading there."
)


def named(scores: dict[str, float]) -> dict[str, float]:
    """Scores with one column a joint; a hand's numbers have none."""
    out = {key: value for key, value in scores.items() if not key.startswith(("n", "cover_n"))}
    if f"n{JOINTS}" in scores:
        out |= {name: scores[f"n{k + 1}"] for k, name in enumerate(ANGLES)}
        out |= {name: scores[f"cover_n{k + 1}"] for k, name in enumerate(COVERED)}
    return out


def over_seeds(rows: Iterable[dict], column: str, form: str = "{:.2f}", factor: float = 1.0) -> str:
    """Mean over the seeds, and their standard deviation where there are three or more; empty without values."""
    values = [factor * row[column] for row in rows if column in row]
    if not values:
        return ""
    text = form.format(mean(values))
    return f"{text} ± {form.format(stdev(values))}" if len(values) > 2 else text


def markdown(rows: Sequence[dict], header: str) -> str:
    """A table for each state and sensor, one of the joints, and one of black frames."""
    seeds = len({row["seed"] for row in rows})
    lines = [header, "", FAIRNESS, "", f"Means over {seeds} seed(s), ± the standard deviation over them."]
    for state, sensor in sorted({(row["state"], row["sensor"]) for row in rows}):
        here = pick(rows, state=state, sensor=sensor)
        unit = "degrees" if state == "arm" else "hundredths of a finger's way"
        lines += ["", f"**{state}, sensor `{sensor}`**: mean absolute error, {unit} / share in the 90 % intervals", ""]
        lines += head("filter", *CONDITIONS, "CRPS, clean", "ms")
        for name in sorted({row["filter"] for row in here}, key=_order(here)):
            own = pick(here, filter=name)
            cells = [_cell(pick(own, condition=condition)) for condition in CONDITIONS]
            clean = pick(own, condition="clean")
            lines.append(line(name, *cells, over_seeds(clean, "crps", "{:.3f}"), over_seeds(clean, "ms_per_step")))
    lines += ["", *_joints(pick(rows, state="arm")), "", *_blackouts(rows)]
    return "\n".join(lines) + "\n"


def _order(rows: Sequence[dict]):
    def key(name: str) -> tuple:
        own = [row["joint_mae_deg"] for row in pick(rows, condition="clean", filter=name)]
        return name not in Baselines.names, mean(own) if own else 0.0

    return key


def _cell(rows: Sequence[dict]) -> str:
    if not rows:
        return ""
    share = mean(100 * row["coverage90"] for row in rows)
    return f"{mean(row['joint_mae_deg'] for row in rows):.2f} / {share:.0f} %"


def _joints(rows: Sequence[dict]) -> list[str]:
    lines = ["By joint, clean: mean absolute error, degrees / share in the 90 % intervals", ""]
    lines += head("filter", "sensor", *(name.replace("_", " ") for name in NAMES))
    clean = pick(rows, condition="clean")
    for sensor in sorted({row["sensor"] for row in clean}):
        here = pick(clean, sensor=sensor)
        for name in sorted({row["filter"] for row in here}, key=_order(here)):
            own = pick(here, filter=name)
            cells = [
                f"{over_mean(own, angle):.2f} / {100 * over_mean(own, share):.0f} %"
                for angle, share in zip(ANGLES, COVERED, strict=True)
            ]
            lines.append(line(name, sensor, *cells))
    return lines


def over_mean(rows: Iterable[dict], column: str) -> float:
    """Mean over the seeds."""
    return mean(row[column] for row in rows)


def _blackouts(rows: Sequence[dict]) -> list[str]:
    lines = [
        "The camera black for 20 frames: error in these frames, and the mean standard deviation before, in the last of "
        "them, and 15 rows after (arm: degrees; hand: hundredths)",
        "",
        *head("state", "filter", "condition", "error", "before", "last black", "after"),
    ]
    chosen = [row for row in rows if BLACKOUT[0] in row and row["sensor"] == "glimpse"]
    for state, name, condition in sorted({(row["state"], row["filter"], row["condition"]) for row in chosen}):
        own = pick(chosen, state=state, filter=name, condition=condition)
        lines.append(line(state, name, condition, *(f"{over_mean(own, column):.2f}" for column in BLACKOUT)))
    return lines
