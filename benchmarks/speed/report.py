"""The table as Markdown, JSON and a picture."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.common.tables import head, line
from benchmarks.speed.pairs import MET
from torch_denkf.deployment.files import write_text


def number(value: float | None, digits: int = 2) -> str:
    """A ratio or a time, short; empty where there is none."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.{digits}f}" if abs(value) < 10 else f"{value:.1f}"


def markdown(rows: list[dict], machine: dict, command: str, seconds: float) -> str:
    """The page of results."""
    lines = [
        "# Speed, side by side",
        "",
        f"`{command}`: {seconds / 60:.0f} min on {machine['processor']}, torch {machine['torch']},",
        f"Python {machine['python']}; each process has one thread on one core. Measured in the same run: matrix peak",
        f"{machine['peak_gflops']:.0f} GFLOP/s (float32), bandwidth {machine['bandwidth_gb_s']:.0f} GB/s.",
        "",
        "Ratios: ours over theirs, below 1 ours is faster; the median over interleaved rounds in one process. A ratio",
        "with a range behind it is the median of separate runs. Times: processor time of a step (S=5, O=2, E=32,",
        "Table I without the image sensor) unless the row says otherwise. Pairs that this command leaves out were",
        "measured before. Plain: the ratio of a compiled filter without this package's passes, from `--plain`.",
        "",
        *head("what", "ratio", "plain", "target", "aim", "met", "ours, us", "theirs, us", "what differs"),
    ]
    for row in rows:
        ratio = number(row["ratio"]) or "not measured"
        if row.get("range"):
            ratio += " ({} to {})".format(*map(number, row["range"]))
        limits = [number(row.get("target")), number(row.get("aim"))]
        times = [number(row.get("ours_us"), 1), number(row.get("theirs_us"), 1)]
        plain = number(row.get("plain"))
        lines.append(line(row["name"], ratio, plain, *limits, MET[row.get("met")], *times, row.get("note", "")))
    return "\n".join(lines) + "\n"


def picture(rows: list[dict], path: Path) -> None:
    """Ratios as bars on a logarithmic axis, with a mark at each target."""
    from benchmarks.common.plots import plt, save

    rows = [row for row in rows if row["ratio"]][::-1]
    figure, axes = plt.subplots(figsize=(9, 0.9 + 0.3 * len(rows)))
    colours = [{True: "tab:green", False: "tab:red"}.get(row.get("met"), "tab:gray") for row in rows]
    axes.barh(range(len(rows)), [row["ratio"] for row in rows], color=colours, height=0.65)
    for place, row in enumerate(rows):
        if row.get("target"):
            axes.plot([row["target"]] * 2, [place - 0.42, place + 0.42], color="black", linewidth=2)
        box = {"facecolor": "white", "edgecolor": "none", "pad": 0.8}  # over the target's bar, if they meet
        axes.text(row["ratio"] * 1.06, place, number(row["ratio"]), va="center", fontsize=8, bbox=box)
    axes.axvline(1.0, color="gray", linewidth=0.8, linestyle=":")
    axes.set_xscale("log")
    axes.set_yticks(range(len(rows)), [row["name"] for row in rows], fontsize=8)
    axes.set_xlabel("ours / theirs (black: target; green: met)")
    axes.margins(x=0.12, y=0.01)
    figure.tight_layout()
    save(figure, path, dpi=120)


def write(rows: list[dict], machine: dict, command: str, seconds: float, results: Path, plot: Path) -> None:
    """Writes speed.json, speed.md and the picture."""
    write_text(results / "speed.json", json.dumps(rows, indent=1) + "\n")
    write_text(results / "speed_machine.json", json.dumps(machine, indent=1) + "\n")
    write_text(results / "speed.md", markdown(rows, machine, command, seconds))
    picture(rows, plot)
