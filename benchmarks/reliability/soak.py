"""Runs that last: a million steps, kills, full disks, many workers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from filelock import FileLock

from benchmarks.common.arguments import command, processor, some_of
from benchmarks.common.tables import head, line
from benchmarks.reliability.soaks import disks, kills, layouts, steps

PARTS = ("steps", "kills", "disks", "layouts")
RESULTS = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Soak:
    """Runs parts of the soak; goes on where an earlier run was left. Leaves soak.json and soak.md."""

    parts: some_of(PARTS) = PARTS  # type: ignore[valid-type]
    """what to run"""
    steps: int = 1_000_000  # of each filter's packaged step
    kills: int = 8  # of each job
    frames: int = 100_000  # of each layout of environments
    seed: int = 0  # of the moments of the kills
    anew: bool = False  # forget what an earlier run found in these parts
    out: Path = RESULTS / "soak.json"
    smoke: bool = False  # a tiny run

    def __call__(self) -> None:
        """Runs the parts, and writes after each row."""
        if self.smoke:
            print(layouts.soak("Collector", 2 * layouts.FRAMES))
            return
        for part in self.parts:
            self.out.parent.mkdir(parents=True, exist_ok=True)
            if self.anew:
                self._keep(part, [])
            for name, job in self._jobs(part).items():
                if any(row["name"] == name for row in self._found(part)):
                    continue
                row = job()
                print(part, json.dumps(row), flush=True)
                with FileLock(self.out.with_suffix(".lock")):  # parts may run in processes of their own
                    self._keep(part, [*self._found(part), row])
        write_table(self.out)

    def _jobs(self, part: str) -> dict[str, Callable[[], dict[str, Any]]]:
        made: dict[str, Callable[[], dict[str, Callable[[], dict[str, Any]]]]] = {
            "steps": lambda: steps.jobs(self.steps),
            "kills": lambda: kills.jobs(self.kills, self.seed),
            "disks": disks.jobs,
            "layouts": lambda: layouts.jobs(self.frames),
        }
        return made[part]()

    def _content(self) -> dict[str, Any]:
        return json.loads(self.out.read_text()) if self.out.exists() else {}

    def _found(self, part: str) -> list[dict[str, Any]]:
        return self._content().get("parts", {}).get(part, [])

    def _keep(self, part: str, rows: list[dict[str, Any]]) -> None:
        content = self._content()
        parts = {**content.get("parts", {}), part: rows}
        everything = [row for name in PARTS for row in parts.get(name, [])]
        content = {
            "command": command("reliability"),
            "processor": processor(),
            "when": time.strftime("%Y-%m-%d", time.gmtime()),
            "rows": len(everything),
            "right": sum(row["right"] for row in everything),
            "seconds": round(sum(row["seconds"] for row in everything)),
            "parts": {name: parts[name] for name in PARTS if name in parts},
        }
        self.out.parent.mkdir(parents=True, exist_ok=True)
        self.out.write_text(json.dumps(content, indent=1) + "\n")


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "**no**"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list):
        return ", ".join(map(str, value)) or "nothing"
    return str(value)


#: The columns of each part's table; all others stay in the JSON file.
COLUMNS = {
    "steps": (
        "steps",
        "unobserved",
        "not finite",
        "mean squared error, first chunk",
        "mean squared error, last chunk",
        "largest difference from the filter",
        "largest difference from a fresh run",
        "memory grown, MB",
    ),
    "kills": ("kills", "equal to an unbroken run", "left behind", "workers that stayed"),
    "disks": ("said", "with room again", "left behind then", "refused", "result"),
    "layouts": (
        "steps",
        "resets",
        "missing readings",
        "largest error, step",
        "largest error, reset",
        "largest error, handed on",
    ),
}
TITLES = {
    "steps": "Packaged steps, compiled ahead of time. Stretches of 10,000 steps in a row bring no reading.",
    "kills": "Work that `kill -9` ended at random moments, and that was started again.",
    "disks": "Disks that are full (tmpfs) or read-only, and two processes that write to one place.",
    "layouts": (
        "A filter inside environments, workers and collectors; each step compared with the same step by hand. Steps "
        f"are counted of all rows: each of the {layouts.ENVIRONMENTS} processes of a ParallelEnv has {layouts.ROWS} "
        f"rows, so that {layouts.ENVIRONMENTS * layouts.ROWS} steps are one exchange between processes."
    ),
}


def write_table(file: Path) -> None:
    """Writes the tables of a JSON file beside it, as Markdown."""
    content = json.loads(file.read_text())
    kills_made = sum(row["kills"] for row in content["parts"].get("kills", []))
    lines = [
        f"{content['right']} of {content['rows']} rows are right; {kills_made} kills; {content['seconds']} s in all on "
        f"{content['processor']}.",
        "",
    ]
    for part, found in content["parts"].items():
        columns = [column for column in COLUMNS[part] if any(column in row for row in found)]
        lines += [TITLES[part], "", *head("", *columns, "right")]
        lines += [
            line(row["name"], *(_cell(row.get(column, "")) for column in columns), _cell(row["right"])) for row in found
        ]
        lines.append("")
    file.with_suffix(".md").write_text("\n".join(lines))
