"""Pictures of what a table left: beliefs as videos and as bands (the paper's Fig. 5), ensemble sizes (Fig. 7)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from benchmarks.common.beliefs import Numbers, read_belief
from benchmarks.common.plots import plt, save
from benchmarks.common.tables import pick
from benchmarks.ur5.study import rows_of

NUMBERS = Numbers(
    [*(f"J{number}, deg" for number in range(1, 7)), "J7, gripper, deg", "x, cm", "y, cm", "z, cm"],
    [180 / math.pi] * 7 + [100.0] * 3,
    0.08,
)
FILMED = (0, 5, 6, 9)  # numbers in a video
COLUMNS = {
    "joint_mae_deg": "joints, mean absolute error, deg",
    "ee_mae_cm": "end effector, mean absolute error, cm",
    "ms_per_step": "time, ms a step",
}


def draw_all(out: Path) -> Iterator[Path]:
    """Draws what a study left in its folder, into ``out/pictures``; yields the files.

    Raises:
        FileNotFoundError: if the folder holds no beliefs yet.
    """
    beliefs, folder = sorted((out / "beliefs").glob("*.pt")), out / "pictures"
    if not beliefs:
        raise FileNotFoundError(f"no beliefs in {out / 'beliefs'}; train and test a filter first, with --out {out}")
    folder.mkdir(exist_ok=True)
    for file in beliefs:
        belief = read_belief(file)
        yield NUMBERS.draw(belief, folder / f"{file.stem}-joints.png", file.stem)
        pixels = belief["pixels"].float() / 255
        yield NUMBERS.film(belief, pixels, FILMED, folder / f"{file.stem}.mp4", file.stem)
    rows = pick(rows_of(out), filter="denkf", domain="sim", training="sim", condition="clean")
    for sensor in sorted({row["sensor"] for row in rows}):
        own = pick(rows, sensor=sensor)
        if len({row["ensemble_size"] for row in own}) > 1:
            yield draw_ensemble_size(own, folder / f"{sensor}-ensemble_size.png")


def draw_ensemble_size(rows: Iterable[dict], path: Path) -> Path:
    """Draws error and time against the number of members: each row a dot, their means a line."""
    table = np.array([[float(row[key]) for key in ("ensemble_size", *COLUMNS)] for row in rows])
    sizes = np.unique(table[:, 0])
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    for column, (axis, label) in enumerate(zip(axes, COLUMNS.values(), strict=True), start=1):
        means = [table[table[:, 0] == size, column].mean() for size in sizes]
        if len(table) > len(sizes):
            axis.plot(table[:, 0], table[:, column], ".", color="tab:blue", alpha=0.35, markersize=6)
        axis.plot(sizes, means, "o-", color="tab:blue")
        axis.set_xscale("log", base=2)
        axis.set_xticks(sizes, [f"{size:.0f}" for size in sizes])
        axis.minorticks_off()
        axis.set(xlabel="members", title=label, ylim=(0, 1.08 * table[:, column].max()))
        axis.grid(alpha=0.3)
    save(figure, path)
    return path
