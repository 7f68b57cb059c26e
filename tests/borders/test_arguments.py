"""Every argument and the lines of files: the error names what is wrong, and has its value."""

import warnings

import pytest

from benchmarks.reliability.case import verdict_on
from benchmarks.reliability.fuzz import GOOD, TESTED, all_targets

ARGUMENTS = [target for target in all_targets(TESTED) if target.name.endswith(")")]
#: Texts of which the letters are checked one by one, and differences of two arguments.
OTHERS = ("num_cells", "channels", "hidden", "taper", "floor", "resampling")
#: Files whose lines and descriptions are checked here, too.
FILES = ("pose 4", "calibration", "meta/episodes.jsonl", "json, data_path", "manifest", "its description")


def judged(targets, root, monkeypatch):
    """Verdicts on all named cases, in this process; each has a folder of its own."""
    cases = [(target, what, value) for target in targets for what, value in target.wrong.named.items()]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for number, (target, what, value) in enumerate(cases):
            folder = root / str(number)
            folder.mkdir()
            monkeypatch.chdir(folder)
            yield target, what, value, verdict_on(target.case((what, value)), folder)


@pytest.mark.parametrize("border", ["filters", "sub-models", "smoothers", "losses", "transforms"])
def test_a_wrong_argument_is_named(border, tmp_path, monkeypatch):
    wrong, count = [], 0
    targets = [target for target in ARGUMENTS if target.border == border]
    for target, what, value, found in judged(targets, tmp_path, monkeypatch):
        shown = not isinstance(value, int | float | str) or repr(value) in found.text or found.kind == "right"
        fine = found.kind in GOOD and (shown or any(f"({name})" in target.name for name in OTHERS))
        wrong += [] if fine else [f"{target.name}: {what}: {found}"]
        count += 1
    assert not wrong, "\n".join(wrong)
    assert count > 70


@pytest.mark.parametrize("part", FILES)
def test_a_damaged_line_is_named(part, tmp_path, monkeypatch):
    targets = [target for target in all_targets(("recorded", "models")) if part in target.name]
    found = list(judged(targets, tmp_path, monkeypatch))
    wrong = [f"{target.name}: {what}: {verdict}" for target, what, _, verdict in found if verdict.kind not in GOOD]
    assert not wrong, "\n".join(wrong)
    assert len(found) > 4
