"""The fuzz suite: runs damaged inputs at every interface, and counts the verdicts."""

from __future__ import annotations

import json
import multiprocessing
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import hypothesis
from hypothesis import strategies as st

from benchmarks.common.arguments import some_of
from benchmarks.common.tables import head, line
from benchmarks.reliability.case import Case, Verdict, judge
from benchmarks.reliability.target import Target

#: Modules of tests/borders.
BORDERS = (
    "filters_made", "sub_models", "around_filters", "readings", "spaces", "noises", "legged", "kitti", "car", "lerobot",
    "ur5", "recordings", "corners", "caches", "logs", "models", "commands",
)  # fmt: skip
KINDS = ("clear", "right", "unclear", "silent", "hang", "crash")
GOOD = KINDS[:2]
RESULTS = Path(__file__).parent / "results"
Row = dict[str, str]  # border, case, kind, message, and the options that repeat it


def all_targets(borders: Sequence[str] = BORDERS) -> list[Target]:
    """Returns the targets of some borders, in a fixed order."""
    modules = [import_module(f"tests.borders.{name}") for name in borders]
    return [target for module in modules for target in module.targets()]


def row(case: Case, verdict: Verdict, again: str) -> Row:
    """Returns the row of a case with its verdict."""
    return {"border": case.border, "case": case.name, "kind": verdict.kind, "what": verdict.text, "again": again}


class Found(AssertionError):
    """Raised for a case whose verdict is neither clear nor right."""


def search(cases: st.SearchStrategy[Case], count: int, seed: int, words: str) -> list[Row]:
    """Draws cases, and returns their rows; the last is the smallest failing one, if any fails.

    Args:
        cases: strategy for cases.
        count: number of cases, if none fails.
        seed: of the draws.
        words: command-line options that repeat the same draws.
    """
    rows: list[Row] = []

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        derandomize=False,
        report_multiple_bugs=False,
        phases=(hypothesis.Phase.generate, hypothesis.Phase.shrink),
        suppress_health_check=list(hypothesis.HealthCheck),
        verbosity=hypothesis.Verbosity.quiet,
    )
    @hypothesis.given(cases)
    def attack(case: Case) -> None:
        verdict = judge(case)
        rows.append(row(case, verdict, words))
        if verdict.kind not in GOOD:
            raise Found(verdict.kind)

    try:
        attack()
    except Found:
        rows = [*(one for one in rows if one["kind"] in GOOD), rows[-1]]
    return rows


def attacked(target: Target, drawn: int, seed: int) -> list[Row]:
    """Returns rows of all named cases of a target, and of some random ones."""
    words = f"--match {f'{target.border} {target.name}:'!r} --drawn {drawn} --seed {seed}"
    rows = [row(case, judge(case), f"--match {f'{case.border} {case.name}'!r} --drawn 0") for case in target.named()]
    if drawn and not target.wrong.others.is_empty:
        rows += search(target.others(), drawn, seed, words)
    return rows


def told(rows: Sequence[Row]) -> None:
    """Prints the failing cases, and the commands that repeat them."""
    for one in rows:
        if one["kind"] not in GOOD:
            print(f"{one['kind']}: {one['border']}: {one['case']}: {one['what']}", flush=True)
            print(f"  again: python -m benchmarks.reliability fuzz {one['again']}", flush=True)


_WORKS: list[Callable[[], list[Row]]] = []  # inherited by forked processes


def _work(number: int) -> list[Row]:
    return _WORKS[number]()


def side_by_side(works: Sequence[Callable[[], list[Row]]], processes: int) -> list[Row]:
    """Runs all jobs, each on the first free process, and returns their rows."""
    rows: list[Row] = []
    _WORKS[:], at = works, time.monotonic()
    with multiprocessing.get_context("fork").Pool(processes) as pool:
        for number, some in enumerate(pool.imap(_work, range(len(works))), start=1):
            rows += some
            told(some)
            if time.monotonic() - at > 10:
                print(f"{number} of {len(works)}: {dict(Counter(one['kind'] for one in rows))}", flush=True)
                at = time.monotonic()
    return rows


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Returns counts of all cases and by border, and the failing cases."""

    def counts(some: Sequence[Row]) -> dict[str, int]:
        kinds = Counter(one["kind"] for one in some)
        return {"records": len(some), **{kind: kinds[kind] for kind in KINDS}}

    names = dict.fromkeys(one["border"] for one in rows)
    borders = {name: counts([one for one in rows if one["border"] == name]) for name in names}
    return {**counts(rows), "borders": borders, "wrong": [one for one in rows if one["kind"] not in GOOD]}


def table(found: dict[str, Any]) -> str:
    """Returns a summary as Markdown."""
    rows = [*found["borders"].items(), ("all", found)]
    lines = [line(name, one["records"], *(one[kind] for kind in KINDS)) for name, one in rows]
    return "\n".join([*head("border", "inputs", *KINDS), *lines, ""])


def sampled(targets: Sequence[Target], count: int, seed: int) -> list[Callable[[], list[Row]]]:
    """Returns jobs that draw ``count`` cases in all, in proportion to the borders' targets, at least one each."""

    def work(border: str) -> list[Row]:
        some = [target for target in targets if target.border == border]
        share, words = max(1, round(count * len(some) / len(targets))), f"--sample {count} --seed {seed}"
        return search(st.sampled_from(some).flatmap(Target.some), share, seed, f"{words} --match {border!r}")

    return [partial(work, border) for border in dict.fromkeys(target.border for target in targets)]


@dataclass(frozen=True)
class Fuzz:
    """Runs damaged inputs and counts their verdicts; writes fuzz.json."""

    sample: int = 0  # number of random cases over all targets; 0 for all named cases and some random ones
    drawn: int = 3  # number of random cases of each target, in addition to the named ones
    seed: int = 0  # of random cases
    borders: some_of(BORDERS) = BORDERS  # type: ignore[valid-type]
    """interfaces to test"""
    processes: int = 2  # that run cases in parallel
    match: str = ""  # only cases with this in their names
    out: Path = RESULTS / "fuzz.json"
    smoke: bool = False  # a tiny run

    def __call__(self) -> None:
        """Runs the suite."""
        began = time.time()
        sample = self.sample or (20 if self.smoke else 0)
        targets = [target.matching(self.match) for target in all_targets(self.borders)]
        targets = [target for target in targets if target.wrong.named and not (sample and target.slow)]
        for needs in {target.needs for target in targets if target.needs}:
            needs()  # once for all
        whole = [partial(attacked, target, self.drawn, self.seed) for target in targets]
        works = sampled(targets, sample, self.seed) if sample else whole
        found = summary(side_by_side(works, self.processes))
        found["seconds"] = round(time.time() - began)
        print(table(found))
        if not (self.smoke or self.match):
            self.out.parent.mkdir(parents=True, exist_ok=True)
            self.out.write_text(json.dumps(found, indent=1) + "\n")
            self.out.with_suffix(".md").write_text(table(found))
