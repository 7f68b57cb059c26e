"""Runs named cases of the borders in this process: each raises clearly, or has the result of its sound part.

``make fuzz`` runs all of them, and drawn ones, each in a process of its own.
"""

import re
import resource
import warnings

import pytest

from benchmarks.reliability.case import MEMORY, verdict_on
from benchmarks.reliability.fuzz import GOOD, all_targets
from benchmarks.reliability.hostile import MARK

#: Modules of borders, where they have other names.
MODULES = {"filters": "filters_made", "sub-models": "sub_models"}
MODULES |= dict.fromkeys(("smoothers", "losses", "transforms"), "around_filters")
MODULES |= dict.fromkeys(("checkpoints", "pretrained", "training", "packages"), "models")
WHOLE = ("kitti", "car", "lerobot", "ur5", "recordings", "corners", "logs", "pretrained", "training")
#: Texts of which the letters are checked one by one, and differences of two arguments.
OTHERS = ("num_cells", "channels", "hidden", "taper", "floor", "resampling", "noise", "limits")


@pytest.fixture(autouse=True)
def _as_in_a_case():
    """Limits memory, which some files ask for without end, and hides warnings."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    with open("/proc/self/statm") as file:
        held = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY, before[1]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def judged(border, part, root, monkeypatch):
    """Yields verdicts on named cases of targets with this in their names; each has a folder of its own."""
    targets = [target for target in all_targets([MODULES.get(border, border)]) if target.border == border]
    targets = [target for target in targets if re.search(part, target.name) and not target.slow]
    cases = [(target, what, value) for target in targets for what, value in target.wrong.named.items()]
    for number, (target, what, value) in enumerate(cases):
        folder = root / str(number)
        folder.mkdir()
        monkeypatch.chdir(folder)
        verdict = verdict_on(target.case((what, value)), folder)
        assert not (folder / MARK).exists(), f"{target.name}: {what} got to run"
        yield target, what, value, verdict


@pytest.mark.parametrize("border", ["filters", "sub-models", "smoothers", "losses", "transforms"])
def test_a_wrong_argument_is_named(border, tmp_path, monkeypatch):
    """The message has its value, too."""
    wrong, count = [], 0
    for target, what, value, found in judged(border, r"\)$", tmp_path, monkeypatch):
        shown = not isinstance(value, int | float | str) or repr(value) in found.text or found.kind == "right"
        fine = found.kind in GOOD and (shown or any(f"({name})" in target.name for name in OTHERS))
        wrong += [] if fine else [f"{target.name}: {what}: {found}"]
        count += 1
    assert not wrong, "\n".join(wrong)
    assert count > 70


#: What is run of borders of which the rest costs seconds: the names of its targets.
SOME = {
    "packages": r"export_step|in its place|its description|graph|hostile|called, observation",
    "checkpoints": "^read",
    "noises": r"sequence, [RQ], (variances|covariance)(, hidden)?$",
    "readings": "sequence, reading",
    "commands": r"^[\w-]+ ",  # options, without files
}


@pytest.mark.parametrize("border", [*WHOLE, *SOME])
def test_damage_raises_clearly_or_gives_the_sound_part(border, tmp_path, monkeypatch):
    found = list(judged(border, SOME.get(border, ""), tmp_path, monkeypatch))
    wrong = [f"{target.name}: {what}: {verdict}" for target, what, _, verdict in found if verdict.kind not in GOOD]
    assert not wrong, "\n".join(wrong)
    assert len(found) > 20
