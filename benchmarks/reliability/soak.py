"""Long runs: a million steps, kills, full disks, many workers."""

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
from benchmarks.reliability.soaks import broken, layouts, steps

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
PARTS = tuple(TITLES)
RESULTS = Path(__file__).parent / "results"
#: Entries that the tables do not show.
NOT_SHOWN = ("name", "right", "seconds", "message")
Row = dict[str, Any]


@dataclass(frozen=True)
class Soak:
    """Runs parts of the soak, resuming an earlier run; writes soak.json and soak.md."""

    parts: some_of(PARTS) = PARTS  # type: ignore[valid-type]
    """parts to run"""
    steps: int = 1_000_000  # of each filter's packaged step
    kills: int = 8  # of each job
    frames: int = 100_000  # of each layout of environments
    seed: int = 0  # of the moments of the kills
    restart: bool = False  # discard an earlier run's rows of these parts
    out: Path = RESULTS / "soak.json"
    smoke: bool = False  # a tiny run

    def __call__(self) -> None:
        """Runs the parts, and writes after each row."""
        if self.smoke:
            print(layouts.soak("Collector", 2 * layouts.FRAMES))
            return
        jobs: dict[str, Callable[[], dict[str, Callable[[], Row]]]] = {
            "steps": lambda: steps.jobs(self.steps),
            "kills": lambda: broken.kill_jobs(self.kills, self.seed),
            "disks": broken.disk_jobs,
            "layouts": lambda: layouts.jobs(self.frames),
        }
        self.out.parent.mkdir(parents=True, exist_ok=True)
        for part in self.parts:
            if self.restart:
                self._keep(part, lambda rows: [])
            for name, job in jobs[part]().items():
                if any(row["name"] == name for row in self._found().get(part, [])):
                    continue
                began = time.monotonic()
                row = {"name": name, **job(), "seconds": round(time.monotonic() - began, 1)}
                print(part, json.dumps(row), flush=True)
                self._keep(part, lambda rows, row=row: [*rows, row])
        write_table(self.out)

    def _found(self) -> dict[str, list[Row]]:
        return json.loads(self.out.read_text())["parts"] if self.out.exists() else {}

    def _keep(self, part: str, change: Callable[[list[Row]], list[Row]]) -> None:
        with FileLock(self.out.with_suffix(".lock")):  # parts may run in separate processes
            parts = self._found()
            parts[part] = change(parts.get(part, []))
            rows = [row for some in parts.values() for row in some]
            content = {
                "command": command("reliability"),
                "processor": processor(),
                "when": time.strftime("%Y-%m-%d", time.gmtime()),
                "rows": len(rows),
                "right": sum(row["right"] for row in rows),
                "seconds": round(sum(row["seconds"] for row in rows)),
                "parts": {name: parts[name] for name in PARTS if name in parts},
            }
            self.out.write_text(json.dumps(content, indent=1) + "\n")


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "**no**"
    if isinstance(value, float):
        return f"{value:.3g}"
    return (", ".join(map(str, value)) or "nothing") if isinstance(value, list) else str(value)


def write_table(file: Path) -> None:
    """Writes the tables of a JSON file next to it, as Markdown."""
    content = json.loads(file.read_text())
    kills = sum(row["kills"] for row in content["parts"].get("kills", []))
    counts = f"{content['right']} of {content['rows']} rows are right; {kills} kills"
    lines = [f"{counts}; {content['seconds']} s in all on {content['processor']}.", ""]
    for part, rows in content["parts"].items():
        columns = [*dict.fromkeys(key for row in rows for key in row if key not in NOT_SHOWN), "right"]
        table = [line(row["name"], *(_cell(row.get(column, "")) for column in columns)) for row in rows]
        lines += [TITLES[part], "", *head("", *columns), *table, ""]
    file.with_suffix(".md").write_text("\n".join(lines))
