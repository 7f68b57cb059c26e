"""Every argument of filters, sub-models, smoothers, losses and transforms: the error names it and has its value."""

import warnings

import pytest

from benchmarks.reliability.case import verdict_on
from benchmarks.reliability.fuzz import GOOD, all_targets

BORDERS = ("filters", "sub-models", "smoothers", "losses", "transforms")
TARGETS = all_targets(("filters_made", "sub_models", "around", "smoothers"))
#: Texts of which the letters are checked one by one, and differences of two arguments.
OTHERS = ("num_cells", "channels", "hidden", "taper", "floor", "resampling")


@pytest.mark.parametrize("border", BORDERS)
def test_a_wrong_argument_is_named(border, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    wrong, count = [], 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for target in (one for one in TARGETS if one.border == border and one.name.endswith(")")):
            for what, value in target.wrong.named.items():
                found = verdict_on(target.case((what, value)), tmp_path)
                shown = not isinstance(value, int | float | str) or repr(value) in found.text or found.kind == "right"
                fine = found.kind in GOOD and (shown or any(f"({name})" in target.name for name in OTHERS))
                wrong += [] if fine else [f"{target.name}: {what}: {found}"]
                count += 1
    assert not wrong, "\n".join(wrong)
    assert count > 70
