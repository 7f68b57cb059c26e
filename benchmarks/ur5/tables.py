"""The table: its columns, and its Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from statistics import median

from benchmarks.common.tables import Columns, head, line, pick
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


def over_seeds(rows: Iterable[dict], column: str, form: str = "{:.2f}") -> str:
    """Median over the seeds, written; empty where no row has the column."""
    values = [row[column] for row in rows if column in row]
    return form.format(median(values)) if values else ""


def markdown(rows: Sequence[dict], header: str) -> str:
    """A table for each domain and training, one of failing cameras, and one of ensemble sizes."""
    lines = [header, "", FAIRNESS, "", f"Medians over {len({row['seed'] for row in rows})} seed(s)."]
    resized = [row for row in rows if _resized(row, rows)]
    main = [row for row in rows if row not in resized]
    for domain in sorted({row["domain"] for row in main}, reverse=True):
        lines += ["", f"**{domain}**", "", *head("trained", "sensor", "filter", *CONDITIONS, "J1 to J7")]
        here = pick(main, domain=domain)
        for method in sorted({_method(row) for row in here}, key=_order(here)):
            own = [row for row in here if _method(row) == method]
            cells = [_cell(pick(own, condition=condition)) for condition in CONDITIONS]
            joints = ", ".join(over_seeds(pick(own, condition="clean"), angle, "{:.1f}") for angle in ANGLES)
            lines.append(line(*method, *cells, joints))
    lines += ["", "Cells: joints deg / end effector cm / share of the true joints in the 90 % intervals.", ""]
    return "\n".join([*lines, *_blackouts(main), "", *_sizes(rows, resized)]) + "\n"


def _method(row: dict) -> tuple[str, str, str]:
    return row["training"], row["sensor"], row["filter"]


def _order(rows: Sequence[dict]):
    def key(method: tuple[str, str, str]) -> tuple:
        own = [row["joint_mae_deg"] for row in pick(rows, condition="clean") if _method(row) == method]
        return *method[:2], method[2] != "sensor", median(own)

    return key


def _cell(rows: Sequence[dict]) -> str:
    if not rows:
        return ""
    covered = over_seeds([{"percent": 100 * row["coverage90"]} for row in rows], "percent", "{:.0f}")
    return f"{over_seeds(rows, 'joint_mae_deg')} / {over_seeds(rows, 'ee_mae_cm')} / {covered} %"


def _resized(row: dict, rows: Sequence[dict]) -> bool:
    """Whether a row is one of the ensemble sizes that is not the filter's own: those have clean rows alone."""
    same = {key: row[key] for key in NAMES if key != "condition"}
    return row["filter"] != "sensor" and not pick(rows, condition="black20", **same)


def _blackouts(rows: Sequence[dict]) -> list[str]:
    lines = [
        "The camera black for 20 frames: error of the joints in these frames, and the mean standard deviation of the "
        "joints before, in the last of them, and 15 steps after, deg",
        "",
        *head("domain", "trained", "sensor", "filter", "error", "before", "last black", "after"),
    ]
    chosen = [row for row in pick(rows, condition="black20") if BLACKOUT[0] in row]
    for key in sorted({(row["domain"], *_method(row)) for row in chosen}, reverse=True):
        own = [row for row in chosen if (row["domain"], *_method(row)) == key]
        lines.append(line(*key, *(over_seeds(own, column) for column in BLACKOUT)))
    return lines


def _sizes(rows: Sequence[dict], resized: Sequence[dict]) -> list[str]:
    lines: list[str] = []
    keys = ("filter", "sensor", "domain", "training")
    titles = ("members", "CRPS, validation demos", "joints deg", "end effector cm", "90 % hold", "ms")
    for same in dict.fromkeys(tuple(row[key] for key in keys) for row in resized):
        own = pick(rows, condition="clean", **dict(zip(keys, same, strict=True)))
        lines += [
            f"Size of the ensemble, {same[0]} on {same[1]}, {same[2]}, trained {same[3]}, clean",
            "",
            *head(*titles),
        ]
        for size in sorted({row["ensemble_size"] for row in own}):
            at = pick(own, ensemble_size=size)
            covered = over_seeds([{"percent": 100 * row["coverage90"]} for row in at], "percent", "{:.0f} %")
            cells = [over_seeds(at, "validation_crps", "{:.3f}"), over_seeds(at, "joint_mae_deg")]
            cells += [over_seeds(at, "ee_mae_cm", "{:.3f}"), covered, over_seeds(at, "ms_per_step")]
            lines.append(line(size, *cells))
        lines.append("")
    return lines
