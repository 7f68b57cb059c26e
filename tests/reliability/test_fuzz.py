"""A sample of the fuzz suite; ``make fuzz`` runs all of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.reliability.case import Case, judge
from benchmarks.reliability.fuzz import all_cases, drawn, summary
from torch_denkf.modules import Select

ROOT = Path(__file__).parents[2]


def test_a_sample_is_refused_clearly_or_right(tmp_path):
    """In a process of its own: cases are forked, and this one may have threads.

    results/fuzz.json lists what is not yet clear or right: 1.5 % of all. A sample is small, and may have more.
    """
    file = tmp_path / "fuzz.json"
    command = [sys.executable, "-m", "benchmarks.reliability", "fuzz", "--sample", "80", "--out", str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    found = json.loads(file.read_text())
    assert found["records"] >= 70
    wrong = json.dumps(found["wrong"], indent=1)
    assert (found["hang"], found["crash"]) == (0, 0), wrong
    assert found["silent"] + found["unclear"] <= 0.05 * found["records"], wrong


def test_the_suite_is_large_and_each_case_has_a_name():
    cases = all_cases()
    names = [(case.border, case.name) for case in cases]
    assert len(cases) >= 1500
    assert len(set(names)) == len(names)
    sample = drawn(cases, 100, seed=3)
    assert {case.border for case in sample} == {case.border for case in cases if not case.slow}
    assert drawn(cases, 100, seed=3) == sample
    assert drawn(cases, 100, seed=4) != sample


def _hang(folder):
    while True:
        pass


def _crash(folder):
    import os

    os.abort()


def _foreign(folder):
    int("dims")


@pytest.mark.parametrize(
    ("act", "right", "kind"),
    [
        (lambda folder: Select([0.5]), None, "clear"),
        (_foreign, None, "unclear"),  # it has the word, but is not this library's
        (lambda folder: 3, None, "silent"),
        (lambda folder: 3, lambda result: result == 3, "right"),
        (lambda folder: 3, lambda result: result == 4, "silent"),
        (_hang, None, "hang"),
        (_crash, None, "crash"),
    ],
)
def test_verdicts(act, right, kind):
    case = Case("test", "case", ("dims",), act, right, within=2.0)
    verdict = judge(case)
    assert verdict.kind == kind, verdict
    found = summary([(case, verdict)])
    assert found["records"] == found[kind] == 1
    assert len(found["wrong"]) == (kind not in ("clear", "right"))


def test_an_error_that_names_something_else_is_unclear():
    assert judge(Case("test", "case", ("matrix",), lambda folder: Select([0.5]))).kind == "unclear"
