"""A sample of the fuzz suite; ``make fuzz`` runs all of it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import strategies as st

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import Case, judge
from benchmarks.reliability.fuzz import all_targets, row, search, summary
from benchmarks.reliability.target import Target
from torch_denkf._checks import check_number
from torch_denkf.modules import Select

ROOT = Path(__file__).parents[2]


def test_a_sample_raises_clearly_or_right(tmp_path):
    """In a process of its own: cases are forked, and this one may have threads.

    The sample is the same each time. It has cases with names, and others.
    """
    file = tmp_path / "fuzz.json"
    command = [sys.executable, "-m", "benchmarks.reliability", "fuzz", "--sample", "60"]
    command += ["--processes", "1", "--out", str(file)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    found = json.loads(file.read_text())
    assert found["records"] >= 55
    wrong = json.dumps(found["wrong"], indent=1)
    assert (found["hang"], found["crash"]) == (0, 0), wrong
    assert found["silent"] + found["unclear"] == 0, wrong


def test_the_suite_is_large_and_each_case_has_a_name():
    targets = all_targets()
    names = [(case.border, case.name) for target in targets for case in target.named()]
    assert len(names) >= 8000
    assert len(set(names)) == len(names)
    assert sum(not target.wrong.others.is_empty for target in targets) >= 1000


def _numbers(act=lambda value, folder: check_number("lags", value, least=5)):
    return Target("test", "number", ("lags",), act, d.Wrong({"four": 4}, d.drawn(st.integers(max_value=4))))


def test_random_cases_raise_reproducibly():
    drawn = [search(_numbers().others(), 6, seed, "") for seed in (0, 0, 1)]
    assert {one["kind"] for rows in drawn for one in rows} == {"clear"}
    assert drawn[0] == drawn[1] != drawn[2]


def _accepts_some(value, folder):
    if value < -1000:
        return value
    return check_number("lags", value, least=5)


def test_a_failure_is_the_smallest_and_runs_again():
    target = _numbers(_accepts_some)
    *good, smallest = search(target.others(), 50, 0, "--match 'test number:'")
    assert {one["kind"] for one in good} <= {"clear"}
    assert (smallest["kind"], smallest["case"]) == ("silent", "number: -1001")
    assert smallest["again"] == "--match 'test number:'"
    assert search(target.others(), 50, 0, "")[-1]["case"] == smallest["case"]


def test_named_cases_are_found_by_their_names():
    target = _numbers()
    assert target.matching("test number") == target
    assert [case.name for case in target.matching("number: four").named()] == ["number: four"]
    assert target.matching("number: five").named() == []


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
    found = summary([row(case, verdict, "")])
    assert found["records"] == found[kind] == 1
    assert len(found["wrong"]) == (kind not in ("clear", "right"))


def test_an_error_that_names_something_else_is_unclear():
    assert judge(Case("test", "case", ("matrix",), lambda folder: Select([0.5]))).kind == "unclear"
