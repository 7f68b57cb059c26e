"""Tests which elements count: masks, resets, padding; and how terms are reduced."""

import pytest
import torch

from tests.filters.factories import toy_denkf
from tests.objectives.denkf_for_tests import CLOSE, ONLY_STATE, score_by_hand
from tests.objectives.problem_for_tests import problem, stepped
from torch_denkf.objectives import DEnKFLoss


def test_done_marks_starts_where_is_init_is_missing(float64):
    filter = toy_denkf()
    frames, _ = problem(filter, resets=False)
    done = torch.zeros(2, 7, 1, dtype=torch.bool)
    done[0, 2] = True
    frames["next", "done"] = done
    value = DEnKFLoss(filter, **ONLY_STATE, reduction="none")(frames)["loss_state"]
    counts = torch.ones(2, 7, dtype=torch.bool)
    counts[:, 0] = counts[0, 3] = False
    assert (value != 0).equal(counts)


@pytest.mark.parametrize("score", ["crps", "mse"])
def test_reductions(float64, score):
    filter = toy_denkf(layer="flipout")
    frames, out = problem(filter)
    values = {
        kind: DEnKFLoss(filter, score=score, kl=0.1, nll=1.0, reduction=kind)(frames)
        for kind in ("none", "sum", "mean")
    }
    masks = {name: stepped(frames) for name in ("state", "transition", "nll")}
    masks["sensor"] = frames["observed"].all(-1)
    for name, mask in masks.items():
        none, total, mean = (values[kind][f"loss_{name}"] for kind in ("none", "sum", "mean"))
        assert none.shape == (2, 7)
        assert (none[~mask] == 0).all()
        if name != "nll":  # the likelihood of no observation is one
            assert (none[mask] != 0).all()
        torch.testing.assert_close(none.sum(), total, **CLOSE)
        torch.testing.assert_close(total / mask.sum(), mean, **CLOSE)
    expected = score_by_hand(score, out["belief", "ensemble"], frames["state"])
    torch.testing.assert_close(values["none"]["loss_state"][masks["state"]], expected[masks["state"]], **CLOSE)


@pytest.mark.parametrize("reduction", ["none", "sum", "mean"])
def test_collector_mask(float64, reduction):
    # Padding at the end of trajectories, as split_trajectories leaves it: it may hold anything.
    filter = toy_denkf()
    frames, _ = problem(filter, resets=False)
    frames["is_init"] = torch.zeros(2, 7, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    mask = torch.ones(2, 7, 1, dtype=torch.bool)
    mask[0, 4:] = mask[1, 6:] = False
    frames["collector", "mask"] = mask
    loss = DEnKFLoss(filter, reduction=reduction)
    before = loss(frames)
    padded = frames.clone()
    padded["state"][~mask.squeeze(-1)] = torch.nan
    padded["target_observation"][~mask.squeeze(-1)] = torch.nan
    after = loss(padded)
    without = frames.exclude("collector")
    for key in list(before.keys()):
        assert before[key].isfinite().all()
        assert after[key].equal(before[key])
        if reduction == "none":
            assert (before[key][~mask.squeeze(-1)] == 0).all()
        else:
            assert not before[key].equal(loss(without)[key])
    sum(value.sum() for value in after.values()).backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in filter.parameters())


def test_nothing_counts_gives_zero():
    filter = toy_denkf()
    frames, _ = problem(filter, batch=(2, 1))
    loss = DEnKFLoss(filter, **ONLY_STATE)(frames)["loss_state"]
    assert loss == 0
