"""Checks what a sensor reads of whole drives: pairs over gaps, mirrored drives, windows in other worlds."""

import pytest
import torch
from tensordict import TensorDict

from torch_denkf.applications.car import dead_reckoning
from torch_denkf.applications.car.odometry.batches import ReadingSampler
from torch_denkf.applications.car.odometry.streams import lose_frames, mirror, rows, shortest_spans

LONGEST = 3


def readings(values, observed=True, longest=1):
    """Reads by two members, half a unit off the values; for n steps n times as much, as at a constant speed."""
    values = torch.as_tensor(values)
    samples = values.unsqueeze(1) + torch.tensor([-0.5, 0.5])[None, :, None]
    spans = torch.stack([n * samples for n in range(1, LONGEST + 1)], 1)
    there = torch.as_tensor(observed).expand(len(values))[:, None, None] & (torch.arange(LONGEST) < longest)[:, None]
    entries = {"observed": there, "ensemble": spans, "encoding": torch.zeros(len(values), LONGEST, 1)}
    state = torch.tensor([[0.0, 0.0, 0.0, 7.0, 0.7]]).repeat(len(values), 1)
    spans = TensorDict(entries, batch_size=[len(values), LONGEST])
    return TensorDict({"state": state, "spans": spans}, [len(values)])


@pytest.mark.parametrize("longest", [1, LONGEST])
def test_missing_frame_masks_the_pairs_that_use_it(longest):
    read = readings([[0.0, 0.0]] * 4000, longest=longest)
    lost = lose_frames(read, seed=3)
    kept = torch.rand(4000, generator=torch.Generator().manual_seed(3)) >= 0.3
    seen = lost["observed"].squeeze(-1)
    for row in range(1, 4000):
        back = next((n for n in range(1, longest + 1) if row >= n and kept[row - n]), 0)
        assert bool(seen[row]) == bool(kept[row] and back)
        if seen[row]:
            assert int(lost["steps"][row]) == back
    # 0.7 x 0.7 of neighbours; over gaps of up to two 0.7 x (1 - 0.3^3); standard error 0.01
    assert float(seen.float().mean()) == pytest.approx(0.7**2 if longest == 1 else 0.7 * (1 - 0.3**3), abs=0.03)
    assert bool(read["spans", "observed"][:, 0].all())  # the original is left as it was


def test_windows_are_faster_or_slower_worlds_that_agree_with_their_readings():
    data = readings(torch.tensor([[8.0, 0.1]]).repeat(60, 1), longest=LONGEST)
    data["state"] = torch.tensor([0.0, 0.0, 0.0, 8.0, 0.1]).repeat(60, 1)
    windows = ReadingSampler([data], [1.0], 8, gain_error=0.0).windows(
        torch.Generator().manual_seed(0), torch.zeros(5), batch=200
    )
    velocity, steps, seen = windows["state"][..., 3:], windows["steps"], windows["observed"].squeeze(-1)
    assert steps.unique().tolist() == [0, 1, 2, 3]
    mean = windows["sensor", "ensemble"].mean(2)
    torch.testing.assert_close(mean[seen], (velocity * steps)[seen])
    assert data["state"].eq(torch.tensor([0.0, 0.0, 0.0, 8.0, 0.1])).all()  # windows are copies
    torch.testing.assert_close(windows["start"], windows["state"])  # no wrong start was asked for
    speed = velocity[:, 0, 0] / 8
    assert 0.36 < float(speed.min()) < 0.45  # exp(-1) and exp(0.7), and 200 draws come near
    assert 1.85 < float(speed.max()) < 2.02
    assert not windows["observed"].all()
    assert windows["is_init"].sum() == 200


def test_mirrored_drive_has_a_mirrored_path():
    rng = torch.Generator().manual_seed(0)
    velocity = torch.rand(30, 2, generator=rng, dtype=torch.float64) + torch.tensor([5.0, -0.5])
    path = dead_reckoning(velocity, torch.zeros(3, dtype=torch.float64), 0.1)
    flow, road = torch.randn(30, 3, 25, 79, generator=rng), torch.rand(30, 13, 69, generator=rng)
    frames = TensorDict({"state": torch.cat([path, velocity], -1), "flow": flow, "road": road}, [30])
    frames["target_observation"] = 2 * velocity
    other = mirror(frames)
    again = dead_reckoning(other["state"][:, 3:], torch.zeros(3, dtype=torch.float64), 0.1)
    torch.testing.assert_close(again, other["state"][:, :3])
    torch.testing.assert_close(other["flow"][:, 0], -flow[:, 0].flip(-1))
    torch.testing.assert_close(other["flow"][:, 1:], flow[:, 1:].flip(-1))
    torch.testing.assert_close(other["target_observation"], 2 * other["state"][:, 3:])
    torch.testing.assert_close(mirror(other)["state"], frames["state"])


def test_a_pair_should_read_the_velocities_of_all_its_steps():
    state = torch.randn(10, 5, generator=torch.Generator().manual_seed(0))
    entries = {"state": state, "flow": torch.zeros(10, 3, 25, 79), "road": torch.zeros(10, 13, 69)}
    entries |= {"frame_valid": torch.ones(10, 1, dtype=torch.bool), "time": torch.zeros(10, 1)}
    for steps in (1, 2, 3):
        stream = TensorDict({**entries, "steps": torch.full((10, 1), steps)}, [10])
        target = rows(stream, torch.tensor([9, 5]), LONGEST)["target_observation"]
        expected = [state[row - steps + 1 : row + 1, 3:].sum(0) for row in (9, 5)]
        torch.testing.assert_close(target, torch.stack(expected))


def test_the_shortest_span_that_is_seen():
    seen = torch.tensor([[1, 1, 1], [0, 1, 1], [0, 0, 1], [0, 0, 0]]).bool().unsqueeze(-1)
    entries = {"observed": seen, "ensemble": torch.arange(3.0).expand(4, 3)[..., None, None].expand(4, 3, 2, 2)}
    readings = TensorDict({"spans": TensorDict({**entries, "encoding": torch.zeros(4, 3, 1)}, [4, 3])}, [4])
    out = shortest_spans(readings.set("state", torch.zeros(4, 5)))
    assert out["steps"].flatten().tolist() == [1, 2, 3, 0]
    assert out["observed"].flatten().tolist() == [True, True, True, False]
    assert out["sensor", "ensemble"][:3, 0, 0].tolist() == [0.0, 1.0, 2.0]
