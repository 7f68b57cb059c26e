"""The table as Markdown and JSON."""

from __future__ import annotations

import json
from pathlib import Path

from benchmarks.common.tables import head, line
from benchmarks.speed.pairs import MET
from torch_denkf.deployment.files import write_text


def number(value: float | None, digits: int = 2) -> str:
    """Formats a ratio or a time with few digits; empty if there is none."""
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.{digits}f}" if abs(value) < 10 else f"{value:.1f}"


def markdown(rows: list[dict], machine: dict, command: str, seconds: float) -> str:
    """Returns the page of results."""
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


def write(rows: list[dict], machine: dict, command: str, seconds: float, results: Path) -> None:
    """Writes speed.json and speed.md."""
    write_text(results / "speed.json", json.dumps(rows, indent=1) + "\n")
    write_text(results / "speed_machine.json", json.dumps(machine, indent=1) + "\n")
    write_text(results / "speed.md", markdown(rows, machine, command, seconds))
