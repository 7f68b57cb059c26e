"""The parts of the G1 study that a wrong table could come from: roles, cameras, baselines, scores, tables."""

import math

import pytest
import torch
from tensordict import TensorDict

from benchmarks.g1.aim import HandPlace
from benchmarks.g1.baselines import Baselines, at_phase, clock, smoothed
from benchmarks.g1.disturbances import before_another, boxed, disturb, shifted
from benchmarks.g1.motion import DELAYS, BiasedReading, Motion, delayed, with_rates
from benchmarks.g1.readings import BLACK, CONDITIONS, PICTURES, Windows, black_readings, blackouts, fail
from benchmarks.g1.recipes.denkf import TAPER, WithEncoders, localisation
from benchmarks.g1.recordings import READ, Recordings, Roles, drawn_recording
from benchmarks.g1.scores import blackout, scores
from benchmarks.g1.sensors import Statistics, code_of, encoding_size, paper_sensor, read_code
from benchmarks.g1.tables import COLUMNS, markdown, named
from benchmarks.g1.targets import ARM, HAND
from benchmarks.g1.together import encoders, lagged
from benchmarks.g1.training import run_filter
from torch_denkf.data import LeRobotReplay
from torch_denkf.fusion import FusedFilter, FusedSensor
from torch_denkf.modules import LinearTransition, MomentPrior, Select

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


def test_repeats_of_the_drawn_robot(tmp_path):
    recordings = Recordings(out=tmp_path, size=(24, 32), drawn=True)
    rows = recordings.open()[:]
    repeat = rows["step"].squeeze(-1) % 4 == 3
    assert not rows["observed"][repeat].any()
    assert rows["observed"][~repeat].float().mean() > 0.9


# Cameras --------------------------------------------------------------------------------------------------------------


def test_a_shifted_picture_and_a_box():
    picture = torch.arange(12.0).view(1, 1, 3, 4)
    assert shifted(picture, 1, 0)[0, 0, 0].tolist() == [0, 0, 1, 2]
    assert shifted(picture, 0, -1)[0, 0, :, 0].tolist() == [4, 8, 8]
    hidden = boxed(torch.ones(2, 3, 60, 80), torch.tensor([[0.0, 0.0], [1.0, -1.0]]), side=0.25)
    assert (hidden[0] == 0).sum().item() == 3 * 20 * 20
    assert (hidden[0, 0, 20:40, 30:50] == 0).all()
    assert (hidden[1] == 0).sum().item() == 3 * 10 * 10  # a quarter of it is in the picture


def test_an_arm_before_another_table():
    arm, table = torch.full((3, 60, 80), 9, dtype=torch.uint8), torch.zeros(3, 60, 80, dtype=torch.uint8)
    out = before_another(arm, torch.tensor([0.5, 0.0]), table, 0.25)  # the hand is in column 60 and row 30
    assert (out[:, 10:, 40:] == 9).all()
    assert int((out == 9).sum()) == 3 * 50 * 40
    assert (before_another(arm, torch.tensor([-1.0, -1.0]), table, 0.1) == 9).all()


def test_disturbed_frames_are_repeatable_and_keep_the_place():
    pixels = torch.randint(0, 256, (40, 3, 24, 32), dtype=torch.uint8)
    place = torch.zeros(40, 2)
    first, moved = disturb(pixels.clone(), place, torch.Generator().manual_seed(3))
    second, _ = disturb(pixels.clone(), place, torch.Generator().manual_seed(3))
    assert torch.equal(first, second)
    assert moved.abs().max() <= 2 * math.ceil(1.2 * 32 / 32) / 24
    assert (moved == 0).all(-1).any()


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


def test_the_hand_is_where_the_picture_changes():
    data = LeRobotReplay(drawn_recording((36, 48)), split="all")
    joints = data.storage[:]["state"][:, 7:14]
    place = HandPlace(data, torch.arange(len(data)), joints)(joints)
    # Two spots move: (columns, rows) = (8, 7) and (13, 10) of the state; the darker one counts for more.
    state = data.storage[:]["state"]
    for column, (near, far) in enumerate(((8, 13), (7, 10))):
        middle = 0.6 * state[:, near] + 0.4 * state[:, far]
        assert float((place[:, column] - middle).abs().mean()) < 0.12


def test_networks_read_together():
    facts = Statistics.of([torch.randn(30, READ)], torch.randint(0, 256, (3, 3, 36, 48), dtype=torch.uint8))
    first, second = paper_sensor(facts), paper_sensor(facts)
    with torch.no_grad():
        pixels = torch.rand(2, 3, 36, 48)
        code = code_of([first, second], pixels)
        samples, encoding = read_code([first, second], code, 7, torch.Generator().manual_seed(0))
        alone, _ = read_code([first], code_of([first], pixels), 4, torch.Generator().manual_seed(0))
        dark = black_readings([first, second], ARM, 7)
    assert torch.equal(samples[:, :4], alone)  # four of the first network, three of the second
    spread = ((samples - facts.loc) / facts.scale).std(1).log()
    torch.testing.assert_close(encoding[:, -READ:], spread, atol=1e-3, rtol=0)
    assert encoding.shape[-1] == encoding_size([first, second])
    assert dark["ensemble"].shape == (1, 1, 7, 7)
    assert not dark["observed"].any()  # for it is black


# Motion and filters ---------------------------------------------------------------------------------------------------


def test_commands_and_rates_in_time():
    action = torch.arange(5.0).unsqueeze(-1)
    assert delayed(action).tolist() == [[float(t), float(max(t - DELAYS[1], 0))] for t in range(5)]
    assert with_rates(action)[:, 1].tolist() == [0.0, 1.0, 1.0, 1.0, 1.0]


def test_an_untrained_motion_keeps_going():
    sequences = [torch.randn(30, 13)]
    facts = Statistics.of(sequences, torch.zeros(3, 3, 4, 4, dtype=torch.uint8))
    motion = Motion(facts, HAND, actions=True)
    state, command = torch.rand(2, 2 * HAND.size), torch.rand(2, 2 * HAND.size)
    moved = motion(torch.cat([state, command], -1))
    rates = torch.tensor(3.0).sigmoid() * state[:, HAND.size :]
    torch.testing.assert_close(moved, torch.cat([state[:, : HAND.size] + rates, rates], -1))


def test_readings_with_bias_and_encoders():
    state = torch.arange(21.0)
    read = BiasedReading(7, (0, 3))(state)
    assert read.tolist() == [*(float(k + 14 + k) for k in range(7)), 0.0, 3.0]
    td = TensorDict(
        {
            "sensor": {"ensemble": torch.zeros(4, 7), "noise": torch.ones(7)},
            "encoders": torch.ones(4, 2),
            "observed": torch.tensor([False]),
        }
    )
    td = WithEncoders(7, 0.1, 2)(td)["both"]
    assert td["observed"].tolist() == [False] * 7 + [True] * 2
    torch.testing.assert_close(td["noise"], torch.tensor([1.0] * 7 + [0.01] * 2))
    assert td["ensemble"].shape == (4, 9)


def test_localisation_goes_by_joint():
    of_state, of_readings = localisation(21, 7, (0, 3))
    assert of_state.shape == (21, 9)
    assert of_readings.shape == (9, 9)
    assert of_state[14, 7] == 1.0  # the bias of the first joint and its encoder
    assert of_state[1, 7] == TAPER
    assert (of_readings.diagonal() == 1).all()


def test_windows_begin_near_what_the_sensor_says():
    clean = readings(error=0.1)
    windows = Windows(dict.fromkeys(PICTURES, clean), black(), 20)
    drawn = windows.sample(torch.Generator().manual_seed(0), 200, torch.full((7,), 0.3), padding=7)
    assert drawn["padded"].shape == (200, 20, 21)
    assert (drawn["padded"][..., 14:] == 0).all()
    off = drawn["start"][:, 0] - drawn["state"][:, 0] - 0.1
    assert abs(float(off.mean())) < 0.03
    assert abs(float(off.std()) - 0.3) < 0.02
    dark = (drawn["sensor", "encoding"] == 7.0).all(-1).any(-1)
    assert 10 < int(dark.sum()) < 60  # a sixth of 200
    assert drawn["observed"][dark].any()


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


def test_a_run_leaves_the_readings_as_they_are():
    one, size = torch.eye(ARM.size), ARM.size
    camera = FusedSensor(Select(range(size)), torch.ones(size), observation_key=("sensor", "ensemble"))
    model = FusedFilter(LinearTransition(one, one), {"camera": camera}, initial=MomentPrior(torch.zeros(size), one))
    given = readings()
    before = set(given.keys(True))
    run_filter(model, given)
    assert set(given.keys(True)) == before


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


def test_table_reads_back_and_is_written(tmp_path):
    clean = readings()
    var = torch.full_like(clean["state"], 0.01)
    rows = []
    for seed in range(3):
        for condition in CONDITIONS:
            score = named(scores(ARM, clean["state"] + 0.01 * seed, var, clean))
            names = {"filter": "denkf", "sensor": "glimpse", "state": "arm", "condition": condition, "seed": seed}
            rows.append({**names, **score, "episodes": COUNT, "ms_per_step": 1.0})
    COLUMNS.write(rows, tmp_path / "table.csv")
    back = COLUMNS.read(tmp_path / "table.csv")
    assert [row["seed"] for row in back[:3]] == [0, 1, 2]
    assert back[1]["elbow_deg"] == pytest.approx(math.degrees(0.01), rel=1e-3)
    page = markdown(back, "made")
    assert "0.57 / 100 %" in page  # the mean of 0, 0.57 and 1.15 degrees


def test_the_last_commands_stand_side_by_side():
    rows = lagged(torch.arange(20.0).unsqueeze(-1).expand(-1, 7))
    assert rows[9, ::7].tolist() == [9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0]
    assert rows.shape == (20, 57)
    assert rows[1, ::7].tolist() == [1.0, *[0.0] * 7, 1.0]


def test_encoders_are_read_when_they_are_due():
    data = TensorDict({"state": torch.ones(2, 100, 7), "valid": torch.ones(2, 100, 1).bool()}, [2, 100])
    out = encoders(data, 1.0)
    assert out["encoder_observed"][0].flatten().nonzero().flatten().tolist() == [0, 30, 60, 90]
    assert (out["encoder"] - 1).rad2deg().std().item() == pytest.approx(0.1, rel=0.1)
