"""Flat batches of torchrl's replay buffers. Oracle: the same data as [B, T], and slice by slice."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, SliceSampler, TensorDictReplayBuffer

from tests.filters.factories import linear_denkf
from torch_denkf.objectives import DEnKFLoss, TransitionLoss

LENGTHS = (9, 7, 12)
CURE = r"TensorDictReplayBuffer.*reshape.*batch\[None\]"


def episodes(*, following=True, init=False):
    """Returns concatenated episodes, as they are stored."""
    rows = []
    for index, count in enumerate(LENGTHS):
        values = torch.randn(count + 1, 2)
        last = torch.arange(count).unsqueeze(-1) == count - 1
        row = {"observation": values[:-1], "state": torch.randn(count, 2), "next": {"done": last}}
        row["episode"] = torch.full((count,), index)
        if following:
            row["next"]["observation"] = values[1:]
        if init:
            row["is_init"] = torch.arange(count).unsqueeze(-1) == 0
        rows.append(TensorDict(row, [count]))
    return torch.cat(rows)


def buffer(kind, rows, key, *, strict=True):
    ways = {"traj_key": {"traj_key": "episode"}, "end_key": {"end_key": ("next", "done")}}
    sampler = SliceSampler(num_slices=4, strict_length=strict, **ways[key])
    out = kind(storage=LazyTensorStorage(len(rows)), sampler=sampler, batch_size=20 if strict else 40)
    out.extend(rows)
    return out


def objective(**kwargs):
    return DEnKFLoss(linear_denkf(), **kwargs)


@pytest.mark.parametrize("key", ["traj_key", "end_key"])
@pytest.mark.parametrize("init", [False, True])
def test_slices_of_one_length_with_marks(float64, key, init):
    batch = buffer(TensorDictReplayBuffer, episodes(init=init), key).sample()
    side_by_side = batch.select("observation", "state").reshape(4, 5)
    loss = objective(nll=1.0)
    expected, got = loss(side_by_side), loss(batch)
    assert set(got.keys()) == {"loss_state", "loss_transition", "loss_nll"}
    for name in list(expected.keys()):
        torch.testing.assert_close(got[name], expected[name], rtol=1e-10, atol=1e-12)
    steps = TransitionLoss(linear_denkf())
    torch.testing.assert_close(steps(batch)["loss_transition"], steps(side_by_side)["loss_transition"])
    assert (objective(reduction="none")(batch)["loss_state"].reshape(4, 5)[:, 0] == 0).all()


@pytest.mark.parametrize("init", [False, True])
def test_slices_of_different_lengths(float64, init):
    batch = buffer(TensorDictReplayBuffer, episodes(init=init), "traj_key", strict=False).sample()
    done = batch["next", "done"].squeeze(-1)
    lengths = (done.nonzero().flatten() + 1).diff(prepend=torch.zeros(1, dtype=torch.long))
    assert lengths.numel() == 4
    assert lengths.unique().numel() > 1
    plain = batch.select("observation", "state").split(lengths.tolist())
    loss, alone = objective(reduction="sum"), objective(reduction="sum")
    expected = sum(alone(part)["loss_state"] for part in plain)
    torch.testing.assert_close(loss(batch)["loss_state"], expected, rtol=1e-10, atol=0)


@pytest.mark.parametrize("key", ["traj_key", "end_key"])
@pytest.mark.parametrize("init", [False, True])
@pytest.mark.parametrize("kept", ["next", "episode", "flags"])
def test_without_marks_slices_raise(key, init, kept):
    data = buffer(ReplayBuffer, episodes(init=init, following=kept != "flags"), key)
    batch = data.sample()
    while not batch["episode"].diff().any():  # slices of one episode: its number says nothing
        batch = data.sample()
    if kept == "next":
        batch = batch.exclude("episode")
    elif kept == "episode":
        batch = batch.exclude("next")
    else:  # nothing is left that could tell
        batch = batch.exclude("episode").set(("next", "done"), torch.zeros(20, 1, dtype=torch.bool))
        if init:
            batch["is_init"] = torch.zeros(20, 1, dtype=torch.bool)
    for loss in (objective(), TransitionLoss(linear_denkf())):
        with pytest.raises(ValueError, match=CURE):
            loss(batch)
        assert loss(batch.reshape(4, 5))["loss_transition"].isfinite()


def test_two_slices_of_one_episode_raise_where_a_clock_tells():
    rows = rows_of()
    objective()(rows)  # nothing says that these are several
    for key, clock, several in (
        ("step", torch.arange(12), False),
        ("step", 3 * torch.arange(12).unsqueeze(-1), False),
        ("step", torch.arange(6).repeat(2), True),
        ("step", torch.cat([torch.arange(6), torch.arange(9, 15)]), True),
        ("time", torch.arange(12) * 0.1 + 0.01 * torch.rand(12), False),
        ("time", torch.cat([torch.arange(6), torch.arange(40, 46)]) * 0.1, True),
        (("collector", "traj_ids"), torch.zeros(12, dtype=torch.long), False),
        (("collector", "traj_ids"), torch.arange(12) // 6, True),
    ):
        batch = rows.copy().set(key, clock)
        if several:
            assert_raises(batch, r"seems to hold several sequences.* at 6, and")
            accepted(batch.set("is_init", torch.arange(12) % 6 == 0), rows.reshape(2, 6))
        else:
            accepted(batch, rows)


@pytest.mark.parametrize("ended", [False, True])
def test_a_rollout_is_one_sequence(ended):
    loss = objective()
    values = torch.randn(10, 2)
    done = torch.zeros(9, 1, dtype=torch.bool)
    done[-1] = ended
    following = {"observation": values[1:], "done": done, "truncated": done}
    rollout = TensorDict({"observation": values[:-1], "state": torch.randn(9, 2), "next": following}, [9])
    expected = loss(rollout.select("observation", "state"))["loss_state"]
    torch.testing.assert_close(loss(rollout)["loss_state"], expected)
    # A robot that stands still, a pixel-wise change of the sampled frames alone, and numbers that are missing.
    rollout["camera"], rollout["next", "camera"] = torch.randn(9, 1), torch.randn(9, 1)
    torch.testing.assert_close(loss(rollout)["loss_state"], expected)
    flags = rollout.copy()
    flags["next"] = flags["next"].select("done", "truncated")
    if ended:
        torch.testing.assert_close(loss(flags)["loss_state"], expected)
    else:
        with pytest.raises(ValueError, match="may hold several sequences"):
            loss(flags)
        torch.testing.assert_close(loss(flags[None])["loss_state"], expected)


def test_an_episode_that_is_done_needs_a_mark_after_it():
    rows = rows_of().set("is_init", torch.arange(12).unsqueeze(-1) == 0)
    rows["next", "done"] = (torch.arange(12) % 6 == 5).unsqueeze(-1)
    assert_raises(rows, r"is done, and the next begins, at 6")


# ------------------------------------------------------------------------------------- what breaks, and what continues


def rows_of(count=12):
    return TensorDict({"observation": torch.randn(count, 2), "state": torch.randn(count, 2)}, [count])


def with_next(rows, breaks_at=None):
    """``rows`` and a ``"next"`` part that is what follows, except for one break."""
    following = torch.roll(rows["observation"], -1, 0).clone()
    if breaks_at is not None:
        following[breaks_at - 1] += 1.0
    done = (torch.arange(len(rows)) == len(rows) - 1).unsqueeze(-1)
    return rows.copy().set("next", TensorDict({"observation": following, "done": done}, [len(rows)]))


def accepted(batch, as_rows):
    torch.testing.assert_close(objective()(batch)["loss_state"], objective()(as_rows)["loss_state"])


def assert_raises(batch, match):
    with pytest.raises(ValueError, match=match):
        objective()(batch)


def test_a_clock_may_leap_within_slices_that_are_marked():
    """A camera that lost a frame; without marks it looks like the next slice."""
    rows = rows_of()
    batch = rows.copy().set("step", torch.tensor([0, 1, 2, 3, 4, 5, 0, 1, 2, 5, 6, 7]))
    assert_raises(batch.select("observation", "state", "step")[5:], "'step' does not go on")
    accepted(batch.set("is_init", torch.arange(12) % 6 == 0), rows.reshape(2, 6))
    batch["step"][10] = 0  # back, that is another one all the same
    assert_raises(batch, r"'step' does not go on.* at 10")


def test_the_numbers_of_the_next_step_are_one_ahead():
    """An episode's number under ``"next"`` changes one element before the mark."""
    rows = rows_of().set("episode", torch.arange(12) // 6)
    rows["is_init"] = (torch.arange(12) % 6 == 0).unsqueeze(-1)
    batch = with_next(rows)
    batch["next", "episode"] = torch.tensor([0] * 5 + [1] * 7)
    accepted(batch, rows.select("observation", "state").reshape(2, 6))


def test_a_marked_beginning_is_enough_where_nothing_else_tells():
    rows = rows_of()
    batch = rows.copy().set(("next", "done"), torch.zeros(12, 1, dtype=torch.bool))
    assert_raises(batch, "may hold several sequences")
    accepted(batch.set("is_init", (torch.arange(12) % 6 == 0).unsqueeze(-1)), rows.reshape(2, 6))
