"""Sequences that continue from stored beliefs of a run, a lag window or a policy. Oracles: the run, single steps."""

import pytest
import torch
from tensordict import TensorDict
from torch import nn

from tests.filters.beliefs_for_tests import BELIEF, ENSEMBLE, close
from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.gaussian_for_tests import linear_filter
from tests.filters.test_contract import fused
from torch_denkf.baselines.iterated import IEnKS
from torch_denkf.modules import FromSensor
from torch_denkf.smoothers import FixedLag

FILTERS = {"DEnKF": linear_denkf, "Kalman": linear_kalman}
RESUMED = {
    **FILTERS,
    "updated at a reset": lambda: linear_denkf(update_at_reset=True),
    "ensemble, lag": lambda: FixedLag(linear_denkf(), 3),
    "Kalman, lag": lambda: FixedLag(linear_kalman(), 3),
    "UKF, lag": lambda: FixedLag(linear_filter("UKF"), 2),
    "fused, late": lambda: fused("ensemble", late=True),
    "fused Kalman, late": lambda: fused("Kalman", late=True),
}
every_filter = pytest.mark.parametrize("name", FILTERS)
pytestmark = pytest.mark.usefixtures("float64")


def readings(*batch):
    return TensorDict({"observation": torch.randn(*batch, 2)}, batch)


def begins_at(*times, size=(2, 9)):
    begins = torch.zeros(*size, 1, dtype=torch.bool)
    begins[:, list(times)] = True
    return begins


# -------------------------------------------------------------------------------------------------------- of a run


@pytest.mark.parametrize("name", RESUMED)
@pytest.mark.parametrize(("begin", "stored"), [(1, "belief_keys"), (5, "belief_keys"), (4, "carry_keys")])
@pytest.mark.parametrize("marked", [False, True])
def test_sequence_resumes_from_the_middle(name, begin, stored, marked):
    """Resumes from the whole belief, or from the carry, from which the smoothed entries follow."""
    filter = RESUMED[name]()
    frames = filter.draw_noise(readings(2, 9))
    whole = filter.sequence(frames.copy())
    rest = frames[:, begin:].copy()
    for key in getattr(filter, stored):
        rest[key] = whole[key][:, begin:]
    if marked:  # as SliceSampler marks the beginning of a slice
        rest["is_init"] = begins_at(0, size=rest.shape)
    close(filter.sequence(rest), whole[:, begin:], filter.belief_keys)
    assert not torch.equal(whole["belief", "mean"][:, -1], whole["belief", "mean"][:, 0])


def test_iterated_smoother_resumes():
    plain = linear_denkf()
    parts = [plain["transition"], None, plain["observation"], plain["noise"]]
    filter = IEnKS(*parts, initial=plain.initial, observation_key="observation", process_noise=[0.0, 0.0])
    frames = readings(2, 8)
    whole, rest = filter.sequence(frames.copy()), frames[:, 4:].copy()
    for key in filter.belief_keys:
        rest[key] = whole[key][:, 4:]
    close(filter.sequence(rest), whole[:, 4:], filter.belief_keys, atol=1e-10)
    # What was smoothed is not carried: of a first element that is all there is, it is the belief itself, of age zero.
    rest = frames[:, 4:].copy()
    for key in filter.carry_keys:
        rest[key] = whole[key][:, 4:]
    alone = filter.sequence(rest)
    close(alone[:, 1:], whole[:, 5:], filter.belief_keys, atol=1e-10)
    for key in filter.belief_keys:
        own = torch.zeros(2, 1) if key[-1] == "age" else whole["belief", key[-1]][:, 4]
        torch.testing.assert_close(alone[key][:, 0], own.to(alone[key].dtype), rtol=0, atol=1e-12)


def test_stored_beliefs_are_used_at_marks_if_complete():
    filter, frames = linear_denkf(), readings(2, 9)
    frames["is_init"] = torch.zeros(2, 9, 1, dtype=torch.bool)
    frames["is_init"][1, 5] = True
    stored = frames.copy().set(ENSEMBLE, 100 + torch.randn(2, 9, 6, 2))
    out = filter.sequence(stored.copy())
    assert out[ENSEMBLE][1, 5].equal(stored[ENSEMBLE][1, 5])
    assert not out[ENSEMBLE][0, 5].equal(stored[ENSEMBLE][0, 5])
    close(filter.sequence(out.exclude(ENSEMBLE)), filter.sequence(frames.copy()), BELIEF)


def test_flat_slices_are_the_slices():
    filter, starts = linear_denkf(), [3, 11, 7]
    whole = filter.sequence(readings(20))
    flat = torch.cat([whole[start : start + 5] for start in starts])
    expected = flat.clone()
    flat["is_init"] = (torch.arange(15) % 5 == 0).unsqueeze(-1)
    torch.nn.init.normal_(flat["forecast", "ensemble"])  # what follows from the belief is computed again
    out = filter.sequence(flat)
    close(out, expected, BELIEF)
    inside = ~flat["is_init"].squeeze(-1)
    close(out[inside], expected[inside], [("forecast", "ensemble")])


# ------------------------------------------------------------------------------------------------------ of a policy


def policy_data(filter, *, again=()):
    """Returns a policy's data ``[2, 7]``: the belief before each step; and what each step gives."""
    frames, rows, steps = readings(2, 7), [], []
    belief = filter.step(filter.initialise(frames[:, 0].copy()).update(frames[:, 0]))
    for t in range(7):
        row = frames[:, t].copy().set(("previous", "known"), torch.full((2, 1), t not in again))
        for key in filter.carry_keys:
            row["previous", *key] = belief[key]
        belief = filter(row.copy())
        rows.append(row)
        steps.append(belief.select(*filter.out_keys))
    return torch.stack(rows, 1), torch.stack(steps, 1)


@every_filter
@pytest.mark.parametrize("again", [(), (3,), (0, 5)])
def test_every_element_is_a_step_diagnostics_and_all(name, again):
    """Without a belief before it, an element is reset: not from what the policy stored for its actor."""
    filter = FILTERS[name]()
    data, steps = policy_data(filter, again=again)
    close(filter.sequence(data.copy()), steps, filter.out_keys)
    known = torch.tensor([t not in again for t in range(7)])
    assert (steps["info", "nis"] != 0).all(0).flatten().equal(known)
    assert filter.stepped(data).equal(known.expand(2, 7))
    for key in filter.carry_keys:
        data[key] = 3.0 * steps[key]
    close(filter.sequence(data.copy()), steps, filter.belief_keys)
    for t in again:
        close(steps[:, t], filter.initialise(TensorDict({}, [2])), filter.belief_keys)
    data = data.exclude(*filter.carry_keys)
    data["is_init"] = torch.zeros(2, 7, 1, dtype=torch.bool)  # marks that say nothing hide no missing belief
    rows = [filter(data[:, t].copy()).select(*filter.out_keys) for t in range(7)]
    close(torch.stack(rows, 1), steps, filter.out_keys)
    close(filter.sequence(data.copy()), steps, filter.out_keys)


@every_filter
def test_within_a_slice_the_belief_is_the_filters_own(name):
    """The beliefs that a policy stored are of older parameters: only where a slice begins one is taken."""
    filter = FILTERS[name]()
    data, steps = policy_data(filter)
    for key in filter.carry_keys:
        data["previous", *key][:, 1:] *= 3.0
    close(filter.sequence(data.copy()), steps, filter.out_keys)
    parts = [filter.sequence(part.copy()) for part in (data[:, :4], data[:, 4:])]
    data["is_init"] = begins_at(0, 4, size=(2, 7))
    close(filter.sequence(data.copy()), torch.cat(parts, 1), filter.out_keys)
    close(filter(data[:, 4].copy()), parts[1][:, 0], filter.out_keys)  # a step continues, too
    assert filter.stepped(data).all()
    assert not filter.stepped(data.exclude("previous"))[:, [0, 4]].any()


def test_the_action_before_drives_the_step_and_need_not_be_stored_twice():
    filter = linear_denkf(control=torch.tensor([[0.5], [-1.0]]))
    frames = readings(2, 7).set("action", torch.randn(2, 7, 1))
    expected = filter.sequence(frames.copy())
    data = frames[:, 1:].exclude("action")
    data["previous"] = {"action": frames["action"][:, :-1], "belief": {"ensemble": expected[ENSEMBLE][:, :-1]}}
    close(filter.sequence(data.copy()), expected[:, 1:], filter.out_keys)
    rows = [filter(data[:, t].copy().set("action", torch.full((2, 1), 9.0))) for t in range(6)]
    close(torch.stack([row.select(*filter.out_keys) for row in rows], 1), expected[:, 1:], filter.out_keys)


@every_filter
@pytest.mark.parametrize("update_at_reset", [False, True])
def test_nan_in_an_unused_reading_of_a_reset_is_allowed(name, update_at_reset):
    """NaN raises only in rows that are not reset, or if the first frame is used."""
    filter = FILTERS[name]().with_options(update_at_reset=update_at_reset)
    row = policy_data(filter, again=(0,))[0][:, 0]
    row["previous", "known"][1] = True
    first, second = row.clone(), row.clone()
    first["observation"][0], second["observation"][1] = torch.nan, torch.nan
    for broken in (first, second)[not update_at_reset :]:
        with pytest.raises(ValueError, match="NaN or infinity in"):
            filter(broken)
    if not update_at_reset:
        torch.testing.assert_close(filter(first)["belief", "mean"], filter(row.copy())["belief", "mean"])


def test_initial_belief_from_the_reading_propagates_nan():
    start = FromSensor([0, 1], [0.0, 0.0], [1.0, 1.0], ensemble_size=6, observation_key="observation")
    broken = TensorDict({"observation": torch.zeros(2, 3, 2)}, [2, 3])
    broken["observation"][1, 0] = torch.nan
    assert linear_denkf(initial=start).sequence(broken.copy())["belief", "mean"][1].isnan().all()
    assert linear_denkf().sequence(broken.copy())["belief", "mean"].isfinite().all()


@pytest.mark.parametrize("way", ["step", "sequence"])
def test_an_episode_that_diverged_leaves_no_gradient_of_nan(way):
    """The belief before the first element is NaN, and the element begins an episode of its own."""
    filter = linear_denkf(noisy=True)
    weight = nn.Parameter(filter["transition"].matrix.clone())
    del filter["transition"].matrix
    filter["transition"].matrix = weight
    data = policy_data(filter)[0]
    data["previous", "known"][0, 0], data["previous", *ENSEMBLE][0, 0] = False, torch.nan
    out = filter(data[:, 0].copy()) if way == "step" else filter.sequence(data)
    out["belief", "mean"].sum().backward()
    assert weight.grad.isfinite().all()
    assert weight.grad.abs().sum() > 0
