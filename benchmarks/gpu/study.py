"""Options, processes and the page of the study."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, Literal

import torch

from benchmarks.common.arguments import command, parse, some_of
from benchmarks.common.tables import head, line, write_page
from benchmarks.gpu.case import WAYS, Found, measure
from benchmarks.gpu.parts import LIMITS, PARTS


@dataclass
class Gpu:
    """Times filters on a GPU, part by part; each row is written at once."""

    out: Path | None = None  # folder for gpu.jsonl, gpu.json and gpu.md
    parts: some_of(PARTS) = tuple(PARTS)  # type: ignore[valid-type]  # parts to run, in this order
    ways: some_of(WAYS) = ("eager", "graph")  # type: ignore[valid-type]  # "compiled": a minute per row
    device: Literal["cuda", "cpu"] = "cuda"
    seconds: float = 0.3  # duration of a case
    limit: float = 360.0  # seconds in all
    smoke: bool = False  # a short check on a processor
    inside: bool = False  # run the parts in this process

    def __call__(self) -> None:
        """Runs the measurements, and prints the table."""
        if self.smoke:
            self.device, self.seconds, self.inside, self.limit = "cpu", 0.0, True, 600.0
        if self.device == "cuda" and not torch.cuda.is_available():
            raise SystemExit("python -m benchmarks.gpu needs a GPU; without one, --smoke tries its code.")
        until = time.monotonic() + self.limit
        rows = []
        for part in self.parts:
            left = min(until - time.monotonic(), float("inf") if self.inside else LIMITS[part])
            rows += self.run_inside(part, until) if self.inside else self.run_apart(part, left)
        if self.inside and not self.smoke:
            return
        page = page_of(rows, about(self.device), self.smoke)
        if self.out is not None:
            self.out.mkdir(parents=True, exist_ok=True)
            (self.out / "gpu.json").write_text(json.dumps({"about": about(self.device), "rows": rows}, indent=1))
        write_page(page, None if self.out is None else self.out / "gpu.md")
        wrong = [row for row in rows if row["note"] and (self.smoke or row["part"] == "equality")]
        wrong = [row for row in wrong if not row["note"].startswith(("ModuleNotFoundError", "not run"))]
        if wrong:
            raise SystemExit(f"failed: {[(row['part'], row['name'], row['way'], row['note']) for row in wrong]}")

    def run_inside(self, part: str, until: float) -> list[dict[str, Any]]:
        """Runs the cases of a part, and appends each row to the file of lines."""
        rows = []
        with torch.random.fork_rng():
            for case in PARTS[part](self.device, self.ways, self.smoke):
                if time.monotonic() > until:
                    found = Found(part, case.name, case.way, case.batch, case.steps, case.gradients, case.dims)
                    found.note = "not run: no time left"
                else:
                    found = measure(part, case, self.device, self.seconds)
                rows.append(found.as_dict())
                said = found.note or f"{found.ms:.3f} ms, {found.rate:,.0f} steps/s, first {found.first_s:.1f} s"
                print(
                    f"{part}: {case.name}, {case.way}, B={case.batch}{', gradients' * case.gradients}: {said}",
                    flush=True,
                )
                if self.out is not None:
                    self.out.mkdir(parents=True, exist_ok=True)
                    with (self.out / "gpu.jsonl").open("a") as stream:
                        stream.write(json.dumps(rows[-1]) + "\n")
        return rows

    def run_apart(self, part: str, left: float) -> list[dict[str, Any]]:
        """Runs a part in a separate process, so that a CUDA error does not end the other parts."""
        if left < 5:
            print(f"{part}: not run, no time left", flush=True)
            return []
        folder = Path("runs/gpu") if self.out is None else self.out
        lines = folder / "gpu.jsonl"
        before = len(lines.read_text().splitlines()) if lines.exists() else 0
        options = ["--parts", part, "--ways", *self.ways, "--seconds", str(self.seconds), "--out", str(folder)]
        options += ["--device", self.device, "--limit", str(max(left - 5, 5)), "--inside"]
        environment = {**os.environ, "OMP_NUM_THREADS": "1"}
        process = subprocess.Popen([sys.executable, "-m", "benchmarks.gpu", *options], env=environment)
        try:
            process.wait(left + 10)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            print(f"{part}: ended after {left:.0f} s", flush=True)
        return [json.loads(text) for text in lines.read_text().splitlines()[before:]] if lines.exists() else []


def about(device: str) -> dict[str, str]:
    """Returns the card, versions and the date."""
    import tensordict
    import torchrl

    card = torch.cuda.get_device_name() if device == "cuda" else "a processor"
    versions = {"torch": torch.__version__, "tensordict": tensordict.__version__, "torchrl": torchrl.__version__}
    return {"device": card, **versions, "date": f"{date.today():%d %B %Y}"}


def page_of(rows: list[dict[str, Any]], about: dict[str, str], smoke: bool) -> str:
    """Returns the Markdown page."""
    versions = ", ".join(f"{name} {value}" for name, value in about.items() if name not in ("device", "date"))
    text = ["# On a GPU", "", f"{about['device']}; {versions}; {about['date']}. Medians, in ms per call."]
    for part in dict.fromkeys(row["part"] for row in rows):
        text += ["", f"## {part.capitalize()}", ""]
        text += head("what", "state", "batch", "steps", "gradients", "way", "ms", "steps/s", "first call, s", "note")
        for row in (row for row in rows if row["part"] == part):
            numbers = ["", "", ""]
            if row["ms"] is not None:
                numbers = [f"{row['ms']:.3g}", f"{row['steps_per_s']:.3g}", f"{row['first_s']:.1f}"]
            if part == "equality":
                numbers = ["", "", ""]
            marks = "yes" if row["gradients"] else ""
            what = (row["name"], row["dims"], f"{row['batch']:,}", row["steps"], marks, row["way"])
            text.append(line(*what, *numbers, row["note"].replace("|", "/")[:80]))
    return "\n".join([*text, "", f"`{command('gpu')}`{' (tiny)' * smoke}"]) + "\n"


def main() -> None:
    """Runs the command line."""
    parse(Gpu)()
