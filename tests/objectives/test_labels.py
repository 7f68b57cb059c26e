"""Gaps in the labels. Oracles: scores by hand of the labelled dimensions alone, and batches without those rows."""

import math

import pytest
import torch

from tests.filters.factories import S, toy_denkf
from tests.objectives.denkf_for_tests import CLOSE, score_by_hand
from tests.objectives.labels_for_tests import CASES, SCALE, TERMS, by_hand, case, gaps
from tests.objectives.problem_for_tests import problem, stepped
from tests.objectives.test_parts import forecasts_by_hand
from torch_denkf.filters import DEnKF
from torch_denkf.functional.manifolds import Flat
from torch_denkf.modules import EnsembleAnalysis, LinearObservation, Select
from torch_denkf.objectives import DEnKFLoss, ObservationLoss, SensorLoss, TransitionLoss

NAN = math.nan


@pytest.fixture(autouse=True)
def _double(float64):
    return


def gradients(value, module):
    parameters = list(module.parameters())
    found = torch.autograd.grad(value, parameters, retain_graph=True, allow_unused=True)
    return [torch.zeros_like(p) if g is None else g for p, g in zip(parameters, found, strict=True)]


def agree(value, expected, module, **close):
    """Compares the number and the gradient."""
    torch.testing.assert_close(value, expected, **(close or {"rtol": 1e-10, "atol": 1e-12}))
    for got, due in zip(gradients(value, module), gradients(expected, module), strict=True):
        assert got.isfinite().all()
        torch.testing.assert_close(got, due, rtol=1e-8, atol=1e-10)


def hidden(frames, labelled, how):
    """Returns frames whose labels have gaps, told by a mask or by NaN."""
    frames = frames.clone()
    if how == "NaN":
        frames["state"] = torch.where(labelled, frames["state"], NAN)
    else:  # a data set holds zero, or whatever it held before
        frames["state"] = torch.where(labelled, frames["state"], 0.0)
        frames["state_observed"] = labelled
    return frames


@pytest.mark.parametrize("how", ["mask", "NaN"])
@pytest.mark.parametrize("name", CASES)
def test_gaps_are_as_if_the_labels_were_not_there(name, how):
    filter, frames, out, loss = case(name, state_scale=SCALE)
    for labelled in gaps():
        losses = loss(hidden(frames, labelled, how))
        for term, prefix in TERMS.items():
            everywhere = labelled.expand(2, 7, S)
            expected = by_hand(name, out, prefix, frames["state"], everywhere, stepped(frames), SCALE)
            agree(losses[f"loss_{term}"], expected, filter)


@pytest.mark.parametrize("name", CASES)
def test_gaps_have_no_loss_and_no_gradient(name):
    filter, frames, _, loss = case(name)
    _, labelled = gaps()
    first = sum(loss(hidden(frames, labelled, "mask")).values())
    expected = gradients(first, filter)
    for junk in (NAN, math.inf, 1e30):
        frames["state"], frames["state_observed"] = torch.where(labelled, frames["state"], junk), labelled
        again = sum(loss(frames).values())
        assert again.equal(first)
        assert all(map(torch.equal, gradients(again, filter), expected))


@pytest.mark.parametrize("how", ["mask", "NaN"])
@pytest.mark.parametrize("name", CASES)
def test_a_batch_without_labels_has_loss_zero_and_gradient_zero(name, how):
    filter, frames, _, loss = case(name)
    frames = hidden(frames, torch.zeros(2, 7, 1, dtype=torch.bool), how)
    for reduction in ("mean", "sum", "none"):
        loss.reduction = reduction
        value = sum(loss(frames).values()).sum()
        assert value == 0
        assert value.requires_grad
        assert all((gradient == 0).all() for gradient in gradients(value, filter))


@pytest.mark.parametrize("name", CASES)
def test_labels_of_a_part_of_the_state(name):
    # Of the leading dimensions; of the dimensions that dims picks out of the whole state; and of dims alone.
    filter, frames, out, loss = case(name, terms=["state"])
    counts, state = stepped(frames), frames["state"]
    short, two = torch.ones(2, 7, S, dtype=torch.bool), {"component_std": [0.3, 2.0]} if "mixture" in name else {}
    short[..., 2:] = False
    first = by_hand(name, out, "belief", state, short & (torch.arange(7) != 3).unsqueeze(-1), counts)
    seen = frames.copy().set("state", state[..., :2])
    seen["state_observed"] = (torch.arange(7) != 3).reshape(1, 7, 1).expand(2, 7, 1)
    agree(loss(seen)["loss_state"], first, filter)
    outer = torch.tensor([True, False, True]) & (torch.arange(7) != 3).unsqueeze(-1)
    expected = by_hand(name, out, "belief", state, outer.expand(2, 7, S), counts)
    chosen = type(loss)(filter, **{**CASES[name][2], **two}, transition=0.0, sensor=0.0, dims=[0, 2])
    seen["state"] = state
    agree(chosen(seen)["loss_state"], expected, filter)
    seen["state"] = state[..., [0, 2]]
    agree(chosen(seen)["loss_state"], expected, filter)


@pytest.mark.parametrize("name", ["members-crps", "members-mse", "particles-crps", "particles-mixture"])
def test_angles_beyond_the_labels_and_members_on_both_sides_of_pi(name):
    _, frames, _, loss = case(name, terms=["state"], space=Flat(3, circular=[0, 2]))
    frames["state"] = frames["state"][..., :2]
    before = loss(frames)["loss_state"]
    frames["state"][..., 0] += 2 * math.pi
    torch.testing.assert_close(loss(frames)["loss_state"], before, rtol=1e-9, atol=1e-12)


# ------------------------------------------------------------------------------------------------- what is read of it


@pytest.mark.parametrize("how", ["mask", "NaN"])
@pytest.mark.parametrize("score", ["crps", "energy", "mse"])
def test_a_sensor_learns_as_if_rows_without_labels_were_taken_out(score, how):
    filter = toy_denkf()
    frames, _ = problem(filter)
    frames = frames.reshape(14)
    known = torch.tensor([True, False, True, True, False, False, True] * 2)
    loss = SensorLoss(filter, score=score, noise=0.3, observation_scale=[2.0, 0.5])
    less = loss(frames[known])
    if how == "NaN":
        frames["target_observation"] = torch.where(known.unsqueeze(-1), frames["target_observation"], NAN)
    else:
        frames["target_observation"] = torch.where(known.unsqueeze(-1), frames["target_observation"], 0.0)
        frames["target_observation_observed"] = known.unsqueeze(-1)
    losses = loss(frames)
    for key in ("loss_sensor", "loss_noise"):
        agree(losses[key], less[key], filter)
    whole = DEnKFLoss(filter, score=score, state=0.0, transition=0.0, observation_scale=[2.0, 0.5])
    agree(whole(frames)["loss_sensor"], less["loss_sensor"], filter)


def known_filter(observation):
    """Returns a learned sensor behind a known observation."""
    toy = toy_denkf()
    return DEnKF(toy["transition"], toy["sensor"], observation, toy["noise"], EnsembleAnalysis(), initial=toy.initial)


@pytest.mark.parametrize("how", ["mask", "NaN"])
@pytest.mark.parametrize("linear", [False, True])
def test_a_known_observation_of_the_true_state_is_a_label_where_it_reads_labels(linear, how):
    matrix = torch.tensor([[0.0, 0.0, 1.0], [2.0, 0.0, -1.0]])
    filter = known_filter(LinearObservation(matrix) if linear else Select([2, 0]))
    frames, out = problem(filter)
    truth = frames["state"] @ matrix.mT if linear else frames["state"][..., [2, 0]]
    whole, some = gaps()
    for labelled in (whole, some):
        seen = labelled.expand(2, 7, S)
        reads = torch.stack([seen[..., 2], seen[..., 0] & seen[..., 2] if linear else seen[..., 0]], -1)
        reads = reads & frames["observed"]
        data = hidden(frames.exclude("target_observation"), labelled, how)
        rows, cols = [], out["sensor", "ensemble"]
        for index in reads.any(-1).nonzero().tolist():
            b, t = index
            kept = reads[b, t].nonzero().flatten()
            rows.append(score_by_hand("crps", cols[b, t][:, kept], truth[b, t][kept]))
        assert 0 < len(rows) < 14
        for loss in (SensorLoss(filter), DEnKFLoss(filter, state=0.0, transition=0.0)):
            agree(loss(data)["loss_sensor"], torch.stack(rows).mean(), filter)
    # Labels of the dimensions 0 and 2 alone are all that is read.
    alone = frames.exclude("target_observation").set("state", frames["state"][..., [0, 2]])
    whole = score_by_hand("crps", out["sensor", "ensemble"], truth)[frames["observed"].all(-1)].mean()
    value = DEnKFLoss(filter, state=0.0, transition=0.0, dims=[0, 2])(alone)["loss_sensor"]
    torch.testing.assert_close(value, whole, **CLOSE)


def test_a_reading_of_fewer_labels_than_components_is_not_broadcast():
    filter = toy_denkf()
    frames, out = problem(filter)
    target = frames["target_observation"][..., :1]
    frames["target_observation"] = target
    expected = score_by_hand("crps", out["sensor", "ensemble"][..., :1], target)[frames["observed"].all(-1)].mean()
    torch.testing.assert_close(SensorLoss(filter)(frames)["loss_sensor"], expected, **CLOSE)
    error = (filter["observation"].module(frames["state"])[..., :1] - target).square().mean()
    torch.testing.assert_close(ObservationLoss(filter)(frames)["loss_observation"], error, **CLOSE)


@pytest.mark.parametrize("how", ["mask", "NaN"])
def test_an_observation_model_learns_from_whole_states_alone(how):
    filter = toy_denkf()
    frames, _ = problem(filter)
    _, some = gaps()
    some[:, 5] = some[0, 2] = True
    known = some.all(-1)
    model, target = filter["observation"].module, frames["target_observation"]
    squares = [(model(frames["state"][b, t]) - target[b, t]).square() for b, t in known.nonzero().tolist()]
    assert 3 <= len(squares) < 14
    assert known.nonzero().tolist()[0] == [0, 2]
    squares[0] = squares[0][:1]
    target[0, 2, 1] = NAN  # and from what is known of a reading
    expected = torch.stack([square.mean() for square in squares]).mean()
    loss = ObservationLoss(filter)
    agree(loss(hidden(frames, some, how))["loss_observation"], expected, loss)
    nothing = loss(hidden(frames, torch.zeros_like(some), how))["loss_observation"]
    assert nothing == 0
    assert all((gradient == 0).all() for gradient in gradients(nothing, loss))


@pytest.mark.parametrize("how", ["mask", "NaN"])
def test_a_step_begins_at_a_whole_state_and_is_scored_where_there_are_labels(how):
    filter = toy_denkf()
    frames, _ = problem(filter, resets=False)
    some = torch.ones(2, 7, S, dtype=torch.bool)
    some[0, 1, 1] = some[0, 4] = some[1, 5, 0] = False
    forecasts, losses = forecasts_by_hand(filter, frames), []
    for b in range(2):
        for t in range(1, 7):
            if some[b, t - 1].all() and some[b, t].any():
                dims = some[b, t].nonzero().flatten()
                losses.append(score_by_hand("crps", forecasts[b, t][:, dims], frames["state"][b, t][dims]))
    assert len(losses) == 8
    loss = TransitionLoss(filter)
    data = hidden(frames, some, how)
    agree(loss(data)["loss_transition"], torch.stack(losses).mean(), loss)
    steps = [
        forecasts[b, t][:, 2:] - frames["state"][b, t, 2:]
        for b in range(2)
        for t in range(1, 7)
        if some[b, t - 1].all() and some[b, t, 2]
    ]
    expected = torch.stack([error.mean(0).square().mean() for error in steps]).mean()
    agree(TransitionLoss(filter, score="mse", dims=[2])(data)["loss_transition"], expected, loss)
    nothing = loss(hidden(frames, torch.zeros_like(some), how))["loss_transition"]
    assert nothing == 0
    assert all((gradient == 0).all() for gradient in gradients(nothing, loss))


# ------------------------------------------------------------------------------------------------------- other names


def test_the_masks_of_renamed_labels_are_those_that_data_sets_write():
    filter = toy_denkf()
    frames, _ = problem(filter)
    whole, _ = gaps()
    expected = DEnKFLoss(filter)(hidden(frames, whole, "mask"))
    renamed = frames.copy()
    renamed["truth", "x"], renamed["truth", "x_observed"] = frames["state"], whole
    loss = DEnKFLoss(filter)
    loss.set_keys(state=("truth", "x"))
    again = loss(renamed.exclude("state"))
    assert all(again[key].equal(expected[key]) for key in expected.keys())  # noqa: SIM118
    renamed["mine"] = renamed["truth"].pop("x_observed")
    loss.set_keys(state_observed="mine")
    again = loss(renamed.exclude("state"))
    assert all(again[key].equal(expected[key]) for key in expected.keys())  # noqa: SIM118
