"""The table: its columns, and its Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from statistics import median

from benchmarks.common.tables import Columns, average, covered, grid, pick
from benchmarks.ur5.demos import JOINTS
from benchmarks.ur5.readings import CONDITIONS

NAMES = ("filter", "sensor", "domain", "training", "condition", "ensemble_size", "seed")
ANGLES = tuple(f"J{number + 1}_deg" for number in range(JOINTS))
BLACKOUT = ("blackout_joint_mae_deg", "std_before_deg", "std_blind_deg", "std_after_deg")
_SCORES = ("joint_mae_deg", "ee_mae_cm", "coverage90", *ANGLES, *BLACKOUT, "validation_crps")
COLUMNS = Columns(
    (*NAMES, *_SCORES, "parameters", "ms_per_step", "demos"),
    text=NAMES[:5],
    whole=("ensemble_size", "seed", "demos", "parameters"),
    order=lambda row: (
        *(row[key] for key in ("domain", "sensor", "training", "filter")),
        *(CONDITIONS.index(row["condition"]), row["ensemble_size"], row["seed"]),
    ),
)
FAIRNESS = (
    "All filters of a sensor start from the same sensor's weights and the same learned motion, and learn from the same "
    "windows of its readings with as many updates; each then trains its own copy of the sensor's head. Each has one "
    "number (a factor on the noise, or tempering of weights) chosen from the same nine values for the coverage on the "
    "same validation demos. 'sensor' is the mean of its samples; where nothing is seen its last reading stays."
)
METHOD = ("training", "sensor", "filter")
over_seeds = partial(average, of=median)


def markdown(rows: Sequence[dict], header: str) -> str:
    """A table for each domain, one of failing cameras, and one of ensemble sizes."""
    lines = [header, "", FAIRNESS, "", f"Medians over {len({row['seed'] for row in rows})} seed(s)."]
    lines += ["Cells: joints deg / end effector cm / coverage of the joints' 90 % intervals."]
    resized = [row for row in rows if _resized(row, rows)]
    main = sorted((row for row in rows if row not in resized), key=_order(rows))
    scores = {name: lambda own, name=name: _cell(pick(own, condition=name)) for name in CONDITIONS}
    scores["J1 to J7"] = lambda own: ", ".join(
        over_seeds(pick(own, condition="clean"), angle, "{:.1f}") for angle in ANGLES
    )
    for domain in dict.fromkeys(row["domain"] for row in main):
        lines += ["", f"**{domain}**", "", *grid(pick(main, domain=domain), METHOD, scores)]
    titles = ("error of the joints, deg", "standard deviation before", "last black", "after")
    dark = {title: lambda own, name=name: over_seeds(own, name) for title, name in zip(titles, BLACKOUT, strict=True)}
    black = [row for row in pick(main, condition="black20") if BLACKOUT[0] in row]
    lines += ["", "The camera black for 20 frames", "", *grid(black, ("domain", *METHOD), dark)]
    sizes = {
        "CRPS, validation demos": lambda own: over_seeds(own, "validation_crps", "{:.3f}"),
        "joints deg": lambda own: over_seeds(own, "joint_mae_deg"),
        "end effector cm": lambda own: over_seeds(own, "ee_mae_cm", "{:.3f}"),
        "90 % coverage": lambda own: covered(own, of=median),
        "ms": lambda own: over_seeds(own, "ms_per_step"),
    }
    own = [*_with_resized(rows, resized)]
    lines += ["", "Size of the ensemble, clean", ""]
    return "\n".join([*lines, *grid(own, ("domain", *METHOD, "ensemble_size"), sizes)]) + "\n"


def _with_resized(rows: Sequence[dict], resized: Sequence[dict]) -> list[dict]:
    """Returns clean rows of all methods that ran with several ensemble sizes, in the order of these."""
    methods = {tuple(row[key] for key in ("domain", *METHOD)) for row in resized}
    clean = [row for row in pick(rows, condition="clean") if tuple(row[key] for key in ("domain", *METHOD)) in methods]
    return sorted(clean, key=lambda row: (*(row[key] for key in ("domain", *METHOD)), row["ensemble_size"]))


def _order(rows: Sequence[dict]):
    def key(row: dict) -> tuple:
        same = {name: row[name] for name in ("domain", *METHOD)}
        clean = [one["joint_mae_deg"] for one in pick(rows, condition="clean", **same)]
        return row["domain"] != "sim", *(row[name] for name in METHOD[:2]), row["filter"] != "sensor", median(clean)

    return key


def _cell(rows: Sequence[dict]) -> str:
    if not rows:
        return ""
    return f"{over_seeds(rows, 'joint_mae_deg')} / {over_seeds(rows, 'ee_mae_cm')} / {covered(rows, of=median)}"


def _resized(row: dict, rows: Sequence[dict]) -> bool:
    """Tells whether a row is one of the ensemble sizes that is not the filter's own: those have clean rows alone."""
    same = {key: row[key] for key in NAMES if key != "condition"}
    return row["filter"] != "sensor" and not pick(rows, condition="black20", **same)
