"""The parts of the G1 study that a wrong table could come from: roles, cameras, baselines, scores, tables."""

import math

import pytest
import torch
from tensordict import TensorDict

from benchmarks.g1.baselines import Baselines, at_phase, clock, smoothed
from benchmarks.g1.motion import with_rates
from benchmarks.g1.readings import BLACK, CONDITIONS, PICTURES, blackouts, fail
from benchmarks.g1.recordings import Recordings, Roles, drawn_recording
from benchmarks.g1.scores import blackout, scores
from benchmarks.g1.targets import ARM
from torch_denkf.data import LeRobotReplay

COUNT, STEPS, MEMBERS, FEATURES = 4, 60, 8, 5


def readings(error=0.0, target=ARM, spread=0.01):
    """A sensor that is wrong by ``error`` everywhere, of sines."""
    generator = torch.Generator().manual_seed(0)
    phase = torch.rand(COUNT, 1, target.size, generator=generator)
    truth = (torch.arange(STEPS).view(1, -1, 1) / 10 + 6.3 * phase).sin()
    samples = (
        truth.unsqueeze(-2) + error + spread * torch.randn(COUNT, STEPS, MEMBERS, target.size, generator=generator)
    )
    seen = torch.ones(COUNT, STEPS, 1, dtype=torch.bool)
    encoding = torch.randn(COUNT, STEPS, FEATURES, generator=generator)
    out = TensorDict(
        {
            "observed": seen,
            "valid": seen.clone(),
            "arrived": seen.clone(),
            "state": truth,
            "start": torch.zeros_like(truth),
        },
        [COUNT, STEPS],
    )
    out["sensor"] = TensorDict({"ensemble": samples, "encoding": encoding}, [COUNT, STEPS])
    out["motion"] = torch.stack([with_rates(one) for one in truth])
    return out


def black(target=ARM, seen=True):
    entries = {"ensemble": torch.full((1, 1, MEMBERS, target.size), 9.0), "encoding": torch.full((1, 1, FEATURES), 7.0)}
    entries["observed"] = torch.full((1, 1, 1), seen)
    return TensorDict(entries, [1, 1])


# Roles ----------------------------------------------------------------------------------------------------------------


def test_no_episode_has_two_roles(tmp_path):
    with pytest.raises(ValueError, match=r"two roles: \[3\]"):
        Roles([1], [2, 3], [4], [3, 5])
    recordings = Recordings(out=tmp_path, size=(12, 16), tune=3, validation=2, drawn=True)
    tests = {e.number for e in LeRobotReplay(drawn_recording((12, 16)), split="test").episodes}
    first, second = recordings.roles(0), recordings.roles(1)
    assert set(first.test) == set(second.test) == tests
    assert (len(first.tune), len(first.validation)) == (3, 2)
    assert len({*first.sensor, *first.tune, *first.validation, *first.test}) == 20
    assert first.sensor != second.sensor


# Cameras --------------------------------------------------------------------------------------------------------------


def test_conditions_hide_what_they_say():
    clean = readings()
    lost = fail(clean, "black20", black())["observed"].squeeze(-1)
    assert (~lost).sum(1).tolist() == [BLACK] * COUNT
    begin = blackouts(torch.full((COUNT,), STEPS))
    assert torch.equal(lost.int().argmin(1), begin)
    assert (fail(clean, "black20", black())["sensor", "encoding"][~lost] == 0).all()
    unannounced = fail(clean, "black20_unannounced", black())
    dark = (unannounced["sensor", "encoding"] == 7.0).all(-1)
    assert torch.equal(dark, ~lost)
    assert unannounced["observed"].all()
    assert (unannounced["sensor", "ensemble"][dark] == 9.0).all()
    recognised = fail(clean, "black20_unannounced", black(seen=False))
    announced = fail(clean, "black20", black())
    assert all(torch.equal(recognised[key], announced[key]) for key in ("observed", "arrived", ("sensor", "ensemble")))
    missing = fail(clean, "missing", black())["observed"].float().mean()
    assert abs(float(missing) - 0.7) < 0.1
    assert clean["observed"].all()


# Motion and filters ---------------------------------------------------------------------------------------------------


# Baselines ------------------------------------------------------------------------------------------------------------


def test_clock_is_the_mean_over_the_phase():
    fast, slow = torch.linspace(0, 1, 11).unsqueeze(-1), torch.linspace(0, 3, 101).unsqueeze(-1)
    mean, var = clock([fast, slow], bins=11)
    torch.testing.assert_close(mean.squeeze(-1), torch.linspace(0, 2, 11))
    torch.testing.assert_close(var.squeeze(-1), 2 * torch.linspace(0, 1, 11).square())
    at = at_phase(mean, torch.tensor([21, 6]), 21)
    torch.testing.assert_close(at[1, :6, 0], torch.linspace(0, 2, 6))
    torch.testing.assert_close(at[0, ::2, 0], torch.linspace(0, 2, 11))
    assert (at[1, 6:] == 2.0).all()  # the episode is over


def test_exponential_filter_against_its_closed_form():
    reading = torch.zeros(1, 6, 1)
    reading[:, 0] = 1.0  # taken as it is; then zeros: 0.7^t
    seen = torch.ones(1, 6, 1, dtype=torch.bool)
    out = smoothed(reading, seen, torch.full((1,), 5.0), 0.3)
    torch.testing.assert_close(out.flatten(), 0.7 ** torch.arange(6.0))
    seen[:, [0, 3]] = False
    out = smoothed(reading, seen, torch.full((1,), 5.0), 0.3)
    assert out.flatten().tolist() == [5.0, 0.0, 0.0, 0.0, 0.0, 0.0]


def test_baselines_of_a_sensor_that_is_off():
    clean = readings(error=0.1)
    everything = dict.fromkeys(PICTURES, clean) | {
        name: fail(clean, name, black()) for name in set(CONDITIONS) - set(PICTURES)
    }
    sequences = list(clean["state"])
    baselines = Baselines(ARM, sequences, everything, everything)
    mean, var = baselines("held", clean)
    assert abs(float((mean - clean["state"]).mean()) - 0.1) < 0.005
    row = scores(ARM, mean, var, clean)
    assert abs(row["joint_mae_deg"] - math.degrees(0.1)) < 0.3
    assert row["coverage90"] > 0.8
    # Where nothing is seen, one holds and the other knows the mean pose alone.
    hidden = fail(clean, "black20", black())
    at = ~hidden["observed"].squeeze(-1)
    held, _ = baselines("held", hidden)
    blind, _ = baselines("sensor", hidden)
    flat = torch.cat(sequences).mean(0)
    torch.testing.assert_close(blind[at], flat.expand_as(blind[at]))
    begin = blackouts(torch.full((COUNT,), STEPS))
    before = clean["sensor", "ensemble"].mean(-2)[torch.arange(COUNT), begin - 1]
    torch.testing.assert_close(held[torch.arange(COUNT), begin + 5], before)
    pose, _ = baselines("mean_pose", clean)
    torch.testing.assert_close(pose[0, 0], flat)


# Scores and tables ----------------------------------------------------------------------------------------------------


def test_scores_leave_out_what_does_not_count():
    clean = readings()
    clean["valid"][1:, 30:] = False
    mean = clean["state"] + torch.tensor([0.01] * 6 + [0.08])
    mean[:, 0], mean[2, 40:] = 99.0, 99.0
    row = scores(ARM, mean, torch.full_like(mean, 0.03**2), clean)
    assert row["joint_mae_deg"] == pytest.approx(math.degrees(0.02), rel=1e-4)
    assert row["n7"] == pytest.approx(math.degrees(0.08), rel=1e-4)
    assert row["coverage90"] == pytest.approx(6 / 7)  # 0.08 is outside of 1.645 x 0.03
    assert row["cover_n7"] == 0.0


def test_blackout_looks_at_the_black_frames():
    clean = readings()
    begin = blackouts(torch.full((COUNT,), STEPS))
    step = torch.arange(STEPS)
    dark = (step >= begin.unsqueeze(-1)) & (step < begin.unsqueeze(-1) + BLACK)
    mean = torch.where(dark.unsqueeze(-1), clean["state"] + 0.1, clean["state"])
    var = torch.where(dark, 0.04, 0.01).unsqueeze(-1).expand_as(mean)
    row = blackout(ARM, mean, var, clean, begin)
    assert row["blackout_mae"] == pytest.approx(math.degrees(0.1), rel=1e-4)
    assert row["std_blind"] == pytest.approx(2 * row["std_before"])
    assert row["std_after"] == pytest.approx(row["std_before"])
