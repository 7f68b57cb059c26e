"""Plots that several studies share. matplotlib draws without a window."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # after the choice of a back-end without a window

from torch_denkf.deployment.files import replacing


def draw_frontier(
    rows: Iterable[dict],
    path: Path | str,
    *,
    error: str,
    label: str,
    time: str = "ms_per_step",
    limit: float | None = None,
) -> None:
    """Draws error against milliseconds per step: a line for each filter, a dot for each ensemble size.

    Args:
        rows: with ``"filter"``, ``"members"``, the error and the time; the first and the last dot of a line are
            labelled with the members.
        path: PNG.
        error: column of the error.
        label: of its axis.
        time: column of the milliseconds.
        limit: rows with a larger error are not drawn; the title has their count.

    Raises:
        ValueError: without rows.
    """
    rows = list(rows)
    kept = [row for row in rows if limit is None or row[error] <= limit]
    if not kept:
        raise ValueError(f"no rows to draw of {len(rows)}: give rows whose {error!r} is at most limit={limit}")
    figure, axis = plt.subplots(figsize=(8, 5), layout="constrained")
    for name in dict.fromkeys(row["filter"] for row in kept):
        own = sorted((row for row in kept if row["filter"] == name), key=lambda row: row["members"])
        points = [(row[time], row[error]) for row in own]
        axis.plot(*zip(*points, strict=True), "o-" if len(own) > 1 else "s", label=name, markersize=5)
        for end in (0, -1) if len(own) > 1 else ():
            axis.annotate(str(own[end]["members"]), points[end], (4, 4), textcoords="offset points", fontsize=8)
    errors = [row[error] for row in kept]
    wide = max(errors) > 2 * min(errors)  # a logarithmic scale has too few labels in a narrower range
    axis.set(xscale="log", yscale="log" if wide else "linear", xlabel="ms per step, one thread", ylabel=label)
    for scale in (axis.xaxis, axis.yaxis) if wide else (axis.xaxis,):
        scale.set_major_formatter("{x:g}")
        scale.set_minor_formatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "235" else "")
    if len(kept) < len(rows):
        axis.set_title(f"not shown, with an error above {limit:g}: {len(rows) - len(kept)}", fontsize=9)
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=9)
    save(figure, path)


def save(figure, path: Path | str, dpi: int = 100) -> None:
    """Writes a figure and closes it."""
    with replacing(path) as beside:
        figure.savefig(beside, dpi=dpi)
    plt.close(figure)
