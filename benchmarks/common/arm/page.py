"""The tables of filters behind one camera: conditions, joints, black frames, and sizes of the ensemble."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from benchmarks.common.tables import markdown

CLEAN = "clean"
BLACKOUT = {
    "blackout_joint_mae_deg": "error of the joints, deg",
    "std_before_deg": "standard deviation before",
    "std_blind_deg": "last black",
    "std_after_deg": "after",
}
SIZES = {
    "validation_crps": ("CRPS, validation", "{:.3f}"),
    "joint_mae_deg": ("joints, deg", "{:.2f}"),
    "ee_mae_cm": ("end effector, cm", "{:.3f}"),
    "coverage90": ("90 % coverage", "{:.0%}"),
    "ms_per_step": ("ms", "{:.2f}"),
}


def page(frame: pd.DataFrame, methods: Sequence[str], joints: Sequence[str], lines: Sequence[str]) -> str:
    """Returns the tables of a study's rows, means over seeds.

    Args:
        frame: rows of all conditions.
        methods: columns that tell filters apart; ensemble sizes that ran only on clean images have a separate table.
        joints: names.
        lines: text before the tables.
    """
    methods = list(methods)
    seeds = frame["seed"].nunique()
    size = "ensemble_size" if "ensemble_size" in frame else None
    runs = [*methods, size] if size else methods
    own = frame.groupby(runs, dropna=False)["condition"].transform("nunique") > 1
    over = frame[own].groupby([*methods, "condition"], sort=False)
    mean, std = over.mean(numeric_only=True), over.std(numeric_only=True)
    mean["cell"] = mean.apply(_cell, axis=1)
    others = sorted(set(frame["condition"]) - {CLEAN})
    table = mean["cell"].unstack("condition")[[CLEAN, *others]]
    clean, spread = (part.xs(CLEAN, level="condition") for part in (mean, std))
    table["by joint, clean"] = clean[[f"{name}_deg" for name in joints]].map("{:.1f}".format).agg(", ".join, axis=1)
    for column, form in {"crps": "{:.3f}", "ms_per_step": "{:.2f}"}.items():
        if column in clean:
            table[column] = clean[column].map(form.format, na_action="ignore")
            table[column] += " ± " + spread[column].map(form.format) if seeds > 2 else ""
    ranked = clean.reset_index().sort_values([*methods[:-1], "joint_mae_deg"]).set_index(methods).index
    cells = "Cells: joints, deg / end effector, cm / coverage of the joints' 90 % intervals; ±: standard deviation."
    out = [*lines, "", f"Means over {seeds} seed(s). {cells}", "", *markdown(table.loc[ranked])]
    dark = mean.dropna(subset=list(BLACKOUT)).xs("black20", level="condition")[list(BLACKOUT)].rename(columns=BLACKOUT)
    out += ["", "The camera black for 20 frames", "", *markdown(dark.map("{:.2f}".format))]
    if size and not own.all():
        several = frame[(frame["condition"] == CLEAN) & frame.groupby(methods)[size].transform("nunique").gt(1)]
        sizes = several.groupby([*methods, size])[list(SIZES)].mean()
        table = pd.DataFrame({title: sizes[key].map(form.format) for key, (title, form) in SIZES.items()})
        out += ["", "Size of the ensemble, clean", "", *markdown(table)]
    return "\n".join(out) + "\n"


def _cell(row: pd.Series) -> str:
    place = f" / {row['ee_mae_cm']:.2f}" if "ee_mae_cm" in row else ""
    return f"{row['joint_mae_deg']:.2f}{place} / {row['coverage90']:.0%}"
