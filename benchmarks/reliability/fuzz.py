"""The fuzz suite: damaged inputs at every border, and what comes of each."""

from __future__ import annotations

import json
import os
import random
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

from benchmarks.common.arguments import some_of
from benchmarks.common.tables import head, line
from benchmarks.reliability.case import Case, Verdict, judge, workshop

__all__ = ["BORDERS", "Fuzz", "all_cases", "run"]

#: Modules of benchmarks/reliability/borders.
BORDERS = (
    "filters_made",
    "sub_models",
    "filters_fed",
    "smoothers",
    "kitti",
    "lerobot",
    "ur5",
    "recordings",
    "caches",
    "checkpoints",
    "packages",
    "pretrained",
    "commands",
    "around",
)
KINDS = ("clear", "right", "unclear", "silent", "hang", "crash")
RESULTS = Path(__file__).parent / "results"


def all_cases(borders: Sequence[str] = BORDERS) -> list[Case]:
    """The damaged inputs, in an order of their own."""
    return [case for name in borders for case in import_module(f"benchmarks.reliability.borders.{name}").cases()]


def drawn(cases: Sequence[Case], count: int, seed: int) -> list[Case]:
    """Some of the cases, of each border its share, at least one; none that takes long to prepare.

    Args:
        cases: all of them.
        count: how many, about.
        seed: another one draws others.
    """
    chance = random.Random(seed)
    borders: dict[str, list[Case]] = {}
    for case in cases:
        if not case.slow:
            borders.setdefault(case.border, []).append(case)
    total = sum(map(len, borders.values()))
    return [
        case
        for some in borders.values()
        for case in chance.sample(some, min(len(some), max(1, round(count * len(some) / total))))
    ]


def run(cases: Sequence[Case], progress: bool = True) -> list[tuple[Case, Verdict]]:
    """Each case with its verdict."""
    out, told = [], time.monotonic()
    for number, case in enumerate(cases, start=1):
        verdict = judge(case)
        out.append((case, verdict))
        if verdict.kind not in ("clear", "right"):
            print(f"{verdict.kind}: {case.border}: {case.name}: {verdict.text}", flush=True)
        if progress and (time.monotonic() - told > 10 or number == len(cases)):
            counts = Counter(verdict.kind for _, verdict in out)
            print(f"{number} of {len(cases)}: {dict(counts)}", flush=True)
            told = time.monotonic()
    return out


def run_side_by_side(cases: Sequence[Case], processes: int) -> list[tuple[Case, Verdict]]:
    """As :func:`run`, in several processes, each of which takes its share of the cases."""
    if processes == 1:
        return run(cases)
    for needs in {case.needs for case in cases if case.needs is not None}:
        needs()  # once for all
    files = [workshop() / f"verdicts-{number}.json" for number in range(processes)]
    children = []
    for number, file in enumerate(files):
        child = os.fork()
        if child == 0:
            try:
                verdicts = [vars(verdict) for _, verdict in run(cases[number::processes])]
                file.write_text(json.dumps(verdicts))
            finally:
                os._exit(0)
        children.append(child)
    for child in children:
        os.waitpid(child, 0)
    shares = [[Verdict(**found) for found in json.loads(file.read_text())] for file in files]
    return [(case, shares[number % processes][number // processes]) for number, case in enumerate(cases)]


def summary(judged: Sequence[tuple[Case, Verdict]]) -> dict[str, Any]:
    """Counts of all, by border, and the cases that are neither clear nor right."""

    def counts(kinds: Sequence[str]) -> dict[str, int]:
        return {"records": len(kinds), **{kind: kinds.count(kind) for kind in KINDS}}

    borders: dict[str, list[str]] = {}
    for case, verdict in judged:
        borders.setdefault(case.border, []).append(verdict.kind)
    wrong = [
        {"border": case.border, "case": case.name, "kind": verdict.kind, "what": verdict.text}
        for case, verdict in judged
        if verdict.kind not in ("clear", "right")
    ]
    everything = counts([verdict.kind for _, verdict in judged])
    return {**everything, "borders": {name: counts(kinds) for name, kinds in borders.items()}, "wrong": wrong}


def table(found: dict[str, Any]) -> str:
    """A summary as Markdown."""
    rows = [*found["borders"].items(), ("all", found)]
    lines = [line(name, row["records"], *(row[kind] for kind in KINDS)) for name, row in rows]
    return "\n".join([*head("border", "inputs", *KINDS), *lines, ""])


@dataclass(frozen=True)
class Fuzz:
    """Runs damaged inputs and counts what comes of them; leaves fuzz.json."""

    sample: int = 0  # so many of the cases, drawn evenly; 0 for all
    seed: int = 0  # of the sample
    borders: some_of(BORDERS) = BORDERS  # type: ignore[valid-type]  # where the inputs come in
    processes: int = 1  # that take cases side by side
    match: str = ""  # only cases that have this in their names
    out: Path = RESULTS / "fuzz.json"
    smoke: bool = False  # a tiny run

    def __call__(self) -> None:
        """Runs the suite."""
        began = time.time()
        cases = [case for case in all_cases(self.borders) if self.match in f"{case.border} {case.name}"]
        sample = self.sample or (20 if self.smoke else 0)
        if sample:
            cases = drawn(cases, sample, self.seed)
        found = summary(run_side_by_side(cases, self.processes))
        found["seconds"] = round(time.time() - began)
        print({kind: found[kind] for kind in ("records", *KINDS)})
        if not self.smoke:
            self.out.parent.mkdir(parents=True, exist_ok=True)
            self.out.write_text(json.dumps(found, indent=1) + "\n")
            self.out.with_suffix(".md").write_text(table(found))
