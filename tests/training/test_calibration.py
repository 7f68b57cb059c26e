"""Oracles: the minimum of a parabola, the standard deviation behind Gaussian errors, readings held by hand."""

from contextlib import nullcontext

import pytest
import torch

from torch_denkf.training import choose, hold_last

# ------------------------------------------------------------------------------------------------------- one number


@pytest.mark.parametrize(("lowest", "best"), [(0.3, 0.5), (1.2, 1.0), (9.0, 2.0)])
def test_the_best_candidate_is_returned_and_left_set(lowest, best):
    tried = []
    with pytest.warns(UserWarning, match="is the last") if best == 2.0 else nullcontext():
        found = choose([0.5, 1.0, 2.0], tried.append, lambda: (tried[-1] - lowest) ** 2)
    assert found == best
    assert tried == [0.5, 1.0, 2.0, best]


def test_a_setting_that_fails_never_wins():
    tried = []
    assert choose([1.0, 2.0], tried.append, lambda: float("nan") if tried[-1] == 1.0 else 5.0) == 2.0
    with pytest.raises(ValueError, match=r"none of the candidates has a finite error: \{1.0: nan, 2.0: inf\}"):
        choose([1.0, 2.0], tried.append, lambda: float("nan") if tried[-1] == 1.0 else float("inf"))
    with pytest.raises(ValueError, match="none of the candidates"):
        choose([], tried.append, lambda: 0.0)


# -------------------------------------------------------------------------------------------------------- hold last


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_coverage_of_each_dimension_in_any_batch(batch):
    values, seen = torch.randn(*batch, 7, 2), torch.rand(*batch, 7, 2) < 0.5
    start = torch.randn(*batch, 2)
    held = hold_last(values, seen, start)
    rows = zip(
        values.movedim(-2, -1).flatten(0, -2),
        seen.movedim(-2, -1).flatten(0, -2),
        start.flatten(),
        held.movedim(-2, -1).flatten(0, -2),
        strict=True,
    )
    for value, mask, last, found in rows:
        for now, there, result in zip(value, mask, found, strict=True):
            last = now if there else last
            assert result == last


def test_rejected_readings_are_not_held():
    values, seen = torch.tensor([[1.0], [9.0], [2.0]]), torch.ones(3, 1, dtype=torch.bool)
    held = hold_last(values, seen, torch.zeros(1), lambda step, last: (values[step] - last).abs() < 5)
    assert held.flatten().tolist() == [1.0, 1.0, 2.0]
