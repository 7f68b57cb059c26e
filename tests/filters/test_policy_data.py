"""Sequences that go on from the beliefs of a policy. Oracle: single steps."""

import pytest
import torch
from tensordict import TensorDict

from tests.filters.beliefs_for_tests import close
from tests.filters.factories import linear_denkf, linear_kalman
from torch_denkf.modules import FromSensor

FILTERS = {"DEnKF": linear_denkf, "Kalman": linear_kalman}
every_filter = pytest.mark.parametrize("name", FILTERS)


pytestmark = pytest.mark.usefixtures("float64")


def policy_data(filter, *, anew=()):
    """Returns a policy's data ``[2, 7]``: the belief before each step; and what each step gives."""
    frames, rows, steps = TensorDict({"observation": torch.randn(2, 7, 2)}, [2, 7]), [], []
    belief = filter.step(filter.initialise(frames[:, 0].copy()).update(frames[:, 0]))
    for t in range(7):
        row = frames[:, t].copy().set(("previous", "known"), torch.full((2, 1), t not in anew))
        for key in filter.carry_keys:
            row["previous", *key] = belief[key]
        belief = filter(row.copy())
        rows.append(row)
        steps.append(belief.select(*filter.out_keys))
    return torch.stack(rows, 1), torch.stack(steps, 1)


@every_filter
@pytest.mark.parametrize("anew", [(), (3,), (0, 5)])
def test_every_element_is_a_step_diagnostics_and_all(name, anew):
    filter = FILTERS[name]()
    data, steps = policy_data(filter, anew=anew)
    out = filter.sequence(data.copy())
    close(out, steps, filter.out_keys)
    for t in range(7):
        assert ((out["info", "nis"][:, t] == 0) == (t in anew)).all()


@every_filter
def test_marks_that_say_nothing_do_not_hide_a_missing_belief(name):
    """Without a belief before it an element starts anew, though ``is_init`` says that none begins."""
    filter = FILTERS[name]()
    data, steps = policy_data(filter, anew=(3,))
    data["is_init"] = torch.zeros(2, 7, 1, dtype=torch.bool)
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
    begins = torch.zeros(2, 7, 1, dtype=torch.bool)
    begins[:, [0, 4]] = True
    parts = [filter.sequence(part.copy()) for part in (data[:, :4], data[:, 4:])]
    close(filter.sequence(data.set("is_init", begins)), torch.cat(parts, 1), filter.out_keys)


@every_filter
def test_an_element_without_a_belief_before_it_starts_from_the_initial_one(name):
    """Not from the belief that the policy stored for its actor."""
    filter = FILTERS[name]()
    data, steps = policy_data(filter, anew=(3,))
    for key in filter.carry_keys:
        data[key] = 3.0 * steps[key]
    out = filter.sequence(data.copy())
    close(out, steps, filter.belief_keys)
    start = filter.initialise(TensorDict({}, [2]))
    close(out[:, 3], start, filter.belief_keys)


def test_the_action_before_drives_the_step_and_need_not_be_stored_twice():
    control = torch.tensor([[0.5], [-1.0]])
    filter = linear_denkf(control=control)
    frames = TensorDict({"observation": torch.randn(2, 7, 2), "action": torch.randn(2, 7, 1)}, [2, 7])
    expected = filter.sequence(frames.copy())
    data = frames[:, 1:].exclude("action")
    for key, value in (("action", frames["action"]), (("belief", "ensemble"), expected["belief", "ensemble"])):
        data.set(("previous", *((key,) if isinstance(key, str) else key)), value[:, :-1])
    close(filter.sequence(data.copy()), expected[:, 1:], filter.out_keys)
    rows = [filter(data[:, t].copy().set("action", torch.full((2, 1), 9.0))) for t in range(6)]
    close(torch.stack([row.select(*filter.out_keys) for row in rows], 1), expected[:, 1:], filter.out_keys)


@every_filter
@pytest.mark.parametrize("update_at_reset", [False, True])
def test_a_reading_that_a_start_does_not_use_may_be_anything(name, update_at_reset):
    """As in a transform. In the other row, and where the first frame is used, it is refused."""
    filter = FILTERS[name]()
    filter = filter.with_options(update_at_reset=update_at_reset)
    row = policy_data(filter, anew=(0,))[0][:, 0]
    row["previous", "known"][1] = True
    first, second = row.copy(), row.copy()
    first["observation"], second["observation"] = row["observation"].clone(), row["observation"].clone()
    first["observation"][0], second["observation"][1] = torch.nan, torch.nan
    with pytest.raises(ValueError, match="NaN or infinity in"):
        filter(second)
    if update_at_reset:
        with pytest.raises(ValueError, match="NaN or infinity in"):
            filter(first)
    else:
        torch.testing.assert_close(filter(first)["belief", "mean"], filter(row.copy())["belief", "mean"])


def test_a_start_that_is_made_of_the_reading_uses_it():
    start = FromSensor([0, 1], [0.0, 0.0], [1.0, 1.0], ensemble_size=6, observation_key="observation")
    broken = TensorDict({"observation": torch.zeros(2, 3, 2)}, [2, 3])
    broken["observation"][1, 0] = torch.nan
    assert linear_denkf(initial=start).sequence(broken.copy())["belief", "mean"][1].isnan().all()
    assert linear_denkf().sequence(broken.copy())["belief", "mean"].isfinite().all()
