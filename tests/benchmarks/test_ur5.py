"""The parts of the UR5 study that a wrong table could come from."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict

from benchmarks.ur5.demos import Roles
from benchmarks.ur5.evaluation import blackout, errors, sensor_rows
from benchmarks.ur5.gallery import draw_all
from benchmarks.ur5.glimpse import GlimpseTrunk, keypoint_trunk, project
from benchmarks.ur5.motion import ERRORS, FADING, SIZE, ArmMotion, AtRest, BiasedReading, WithBias, with_rates
from benchmarks.ur5.readings import BLACK, Windows, blackouts, fail, read_head
from benchmarks.ur5.recipes import FILTERS
from benchmarks.ur5.recipes.denkf import localisation
from benchmarks.ur5.sensors import (
    MEMBERS,
    NEAR,
    SENSORS,
    BlackIsMissing,
    NearForecast,
    Statistics,
    TurnedWrist,
    wrist_of,
)
from benchmarks.ur5.tables import COLUMNS, markdown
from benchmarks.ur5.training import run_filter

FACTS = Statistics(
    loc=torch.linspace(-1, 1, 10),
    scale=torch.linspace(0.1, 1, 10),
    rate=torch.full((7,), 0.01),
    acceleration=torch.full((7,), 0.001),
    pixel_loc=torch.full((3,), 0.5),
    pixel_scale=torch.full((3,), 0.2),
    size=32,
)


def states(*size, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return FACTS.loc + FACTS.scale * torch.randn(*size, 10, generator=generator)


def test_who_is_tested_is_not_trained_on():
    with pytest.raises(ValueError, match=r"\[3\] would be tested on and used as tune"):
        Roles({1}, [2, 3], [4], [3, 5])
    with pytest.raises(ValueError, match="its sensor has not seen"):
        Roles({1, 2}, [2], [4], [5])


# ------------------------------------------------------------------------------------------------------ the wrist


def test_a_reading_of_the_turned_wrist_gives_the_state_back_from_any_angle_within_a_quarter_turn():
    state = states(200)
    state[:, 5] = torch.linspace(-5, 5, 200)
    reading = TurnedWrist()(state)
    torch.testing.assert_close(wrist_of(reading, state[:, 5] + 1.5), state, atol=1e-5, rtol=0)
    other = wrist_of(reading, state[:, 5] + math.pi)  # half a turn on it looks the same
    torch.testing.assert_close(other[:, 5], state[:, 5] + math.pi, atol=1e-5, rtol=0)


def test_a_radian_of_the_wrist_is_a_unit_of_its_reading():
    state = states(3).double().requires_grad_()
    reading = TurnedWrist()(state)
    slope = torch.stack([torch.autograd.grad(reading[:, n].sum(), state, retain_graph=True)[0][:, 5] for n in (5, 6)])
    torch.testing.assert_close(slope.norm(dim=0), torch.ones(3, dtype=torch.double))


@pytest.mark.parametrize("weighted", [False, True])
def test_samples_turn_to_the_side_of_the_forecast(weighted):
    state = states(2)
    state[:, 5] = torch.tensor([1.0, 1.0])
    samples = TurnedWrist()(state).unsqueeze(1).repeat(1, 4, 1)
    forecast = torch.zeros(2, 3, SIZE)
    forecast[0, :, 5], forecast[1, :, 5] = torch.tensor([0.5, 1.0, 1.2]), torch.tensor([1.0, 4.0, 4.2])
    td = TensorDict({"sensor": {"ensemble": samples}, "forecast": {"ensemble": forecast}}, [2])
    if weighted:  # all weight on the first particle, which is near 1 in both rows
        td["forecast", "log_weight"] = torch.tensor([1.0, 1e-9, 1e-9]).log().expand(2, -1)
    near = NearForecast(SENSORS["keypoints"])(td)[NEAR]
    expected = torch.tensor([1.0, 1.0 if weighted else 1.0 + math.pi])
    torch.testing.assert_close(near[..., 5], expected.unsqueeze(-1).expand(2, 4), atol=1e-5, rtol=0)


def test_a_factor_scales_the_samples_around_their_mean():
    near = NearForecast(SENSORS["paper"])
    samples = states(2, 5)
    td = TensorDict({"sensor": {"ensemble": samples}, "forecast": {"ensemble": torch.zeros(2, 3, SIZE)}}, [2])
    near.factor = 1.5
    out = near(td)[NEAR]
    torch.testing.assert_close(out.mean(1), samples.mean(1))
    torch.testing.assert_close(out.std(1), 1.5 * samples.std(1))


# ------------------------------------------------------------------------------------------------------ the motion


def test_rates_are_the_joints_changes_and_an_episode_begins_at_rest():
    sequence = states(2, 5)
    full = with_rates(sequence)
    torch.testing.assert_close(full[:, 1:, 10:], sequence[:, 1:, :7] - sequence[:, :-1, :7])
    assert float(full[:, 0, 10:].abs().max()) == 0.0


def test_the_place_follows_the_joints_and_keeps_a_share_of_its_difference():
    torch.manual_seed(0)
    motion = ArmMotion(FACTS)
    state = torch.cat([states(6), 0.01 * torch.randn(6, 7)], -1)
    moved = motion(state)
    torch.testing.assert_close(moved[:, :7], state[:, :7] + moved[:, 10:])
    torch.testing.assert_close(moved[:, 10:], torch.sigmoid(torch.tensor(4.0)) * state[:, 10:])  # before training
    expected = motion.place(moved[:, :7]) + 0.5 * (state[:, 7:10] - motion.place(state[:, :7]))
    torch.testing.assert_close(moved[:, 7:10], expected)


def test_an_arm_that_is_told_where_to_go_goes_there_but_does_not_shut_its_fingers_through_an_object():
    motion = ArmMotion(FACTS, actions=True)
    motion.pull.data.fill_(1.0)
    state = torch.cat([states(1), torch.zeros(1, 7)], -1)
    action = state[:, :7] + 0.02
    action[:, 6] = state[:, 6] - 0.5
    moved = motion(torch.cat([state, action], -1))
    torch.testing.assert_close(moved[:, :6], action[:, :6])
    torch.testing.assert_close(moved[:, 6], state[:, 6])


def test_biases_fade_and_add_to_the_reading():
    motion = ArmMotion(FACTS)
    network = WithBias(motion)
    state = torch.cat([states(3), torch.zeros(3, 7), torch.ones(3, 10)], -1)
    moved = network(state)
    torch.testing.assert_close(moved[:, :SIZE], motion(state[:, :SIZE]))
    torch.testing.assert_close(moved[:, SIZE:], torch.full((3, 10), FADING))
    torch.testing.assert_close(BiasedReading()(state), state[:, :10] + 1)
    torch.testing.assert_close(BiasedReading()(state[:, :SIZE]), state[:, :10])


# ------------------------------------------------------------------------------------------------ failing cameras


def test_black_frames_are_missing_and_dark_ones_are_not():
    pixels = torch.zeros(3, 3, 4, 4)
    pixels[1, 0, 2, 2] = 0.3
    pixels[2] = 0.5
    td = BlackIsMissing()(TensorDict({"pixels": pixels, "observed": torch.tensor([[True], [True], [False]])}, [3]))
    assert td["observed"].squeeze(-1).tolist() == [False, True, False]
    td = BlackIsMissing()(TensorDict({"pixels": (pixels * 255).to(torch.uint8)}, [3]))
    assert td["observed"].squeeze(-1).tolist() == [False, True, True]


def test_conditions_hide_what_they_say():
    readings = TensorDict({"observed": torch.ones(40, 100, 1, dtype=torch.bool)}, [40, 100])
    black = fail(readings, "black20")["observed"].squeeze(-1)
    assert (~black).sum(1).tolist() == [BLACK] * 40
    first = black.int().argmin(1)
    assert torch.equal(first, blackouts(40, 100))
    assert all(not row[begin : begin + BLACK].any() for row, begin in zip(black, first, strict=True))
    missing = fail(readings, "missing")["observed"]
    assert abs(float(missing.float().mean()) - 0.7) < 0.025  # 3.5 standard errors of 4000 draws
    assert bool(missing[:, 0].all())
    assert bool(readings["observed"].all())


def test_windows_begin_wrong_as_they_are_told_and_are_true_otherwise():
    full = with_rates(states(3, 50))
    entries = {"state": full[..., :10], "motion": full, "observed": torch.ones(3, 50, 1, dtype=torch.bool)}
    std = torch.linspace(0.1, 1.0, SIZE)
    windows = Windows([TensorDict(entries, [3, 50])], 8, std).sample(torch.Generator().manual_seed(0), 400)
    wrong = (windows["start"] - windows["motion"]) / std
    torch.testing.assert_close(wrong[:, 0], wrong[:, -1], atol=1e-4, rtol=0)
    # 400 draws: the standard error of a standard deviation is 0.035.
    torch.testing.assert_close(wrong[:, 0].std(0), torch.ones(SIZE), atol=0.15, rtol=0)
    rates = windows["state"][:, 1:, :7] - windows["state"][:, :-1, :7]
    torch.testing.assert_close(windows["motion"][:, 1:, 10:], rates)
    assert 0.6 < float(windows["observed"].float().mean()) < 0.95
    torch.testing.assert_close(windows["hint"][:, 1, :10], windows["start"][:, 0, :10])
    assert float(windows["hint"][:, [0, *range(2, 8)]].abs().max()) == 0.0


# --------------------------------------------------------------------------------------------------------- scores


def test_errors_are_means_of_absolute_ones_with_wrapped_angles_and_without_the_first_row():
    truth = states(2, 5)
    mean = truth.clone()
    mean[:, 1:, 5] += 2 * math.pi - math.radians(7.0)
    mean[:, 1:, 6] += math.radians(14.0)
    mean[:, 1:, 8] += 0.03
    mean[:, 0] += 100.0
    scores = errors(mean, truth)
    assert scores["joint_mae_deg"] == pytest.approx(3.0, abs=1e-3)
    assert scores["J6_deg"] == pytest.approx(7.0, abs=1e-3)
    assert scores["ee_mae_cm"] == pytest.approx(1.0, abs=1e-4)


def test_a_blackout_is_scored_in_its_own_rows():
    truth, begin = torch.zeros(1, 80, 10), torch.tensor([30])
    mean, var = truth.clone(), torch.full((1, 80, 17), math.radians(1.0) ** 2)
    mean[:, 30:50, :7] = math.radians(2.0)
    var[:, 49] = math.radians(5.0) ** 2
    var[:, 65] = math.radians(1.5) ** 2
    scores = blackout(mean, var, truth, begin)
    assert list(scores.values()) == pytest.approx([2.0, 1.0, 5.0, 1.5], abs=1e-4)


def test_a_perfect_sensor_has_no_error_where_it_sees():
    truth = states(2, 6)
    truth[..., 5] = 3.0
    samples = TurnedWrist()(truth).unsqueeze(-2) + 0.001 * torch.tensor([-1.0, 1.0])[:, None]
    reading = TensorDict({"state": truth, "sensor": {"ensemble": samples}}, [2, 6])
    reading["observed"] = torch.ones(2, 6, 1, dtype=torch.bool)
    (row,) = sensor_rows(SENSORS["keypoints"], {"clean": reading}, {})
    assert row["joint_mae_deg"] < 1e-3
    assert row["ee_mae_cm"] < 1e-3
    assert row["coverage90"] == 1.0


# ------------------------------------------------------------------------------------------------ sensors, filters


def test_places_project_as_a_pinhole_has_it():
    # The camera's target is in the middle; what is 1.58 m behind it, 0.1 m to the left of the arm, is on the right.
    assert project(torch.tensor([-0.18, 0.02, 0.27])).abs().max() < 1e-6
    right, low = project(torch.tensor([[-0.18, 0.12, 0.27], [-0.18, 0.02, 0.17]]))
    depth = math.dist((1.4, 0.0, 0.85), (-0.18, 0.02, 0.27)) * math.tan(math.radians(16.5))
    assert float(right[0]) == pytest.approx(0.1 / depth, rel=0.02)
    assert float(low[1]) > 0.15
    assert abs(float(low[0])) < 0.01


def test_a_second_look_is_aimed_at_where_the_coarse_code_says():
    torch.manual_seed(0)
    trunk = GlimpseTrunk(torch.nn.Flatten(), 2, 12, 16)
    images = torch.rand(300, 3, 2, 2)
    # Places whose projections are linear in the picture.
    places = torch.tensor([-0.18, 0.02, 0.27]) + torch.tensor([0.0, 0.01, 0.0]) * images[:, :1, 0, 0]
    assert trunk.aim(images, places) < 0.01
    assert trunk(torch.rand(2, 3, 2, 2)).shape == (2, 16)
    assert keypoint_trunk()(torch.rand(2, 3, 32, 32)).shape == (2, 256)


def test_the_first_look_gets_a_smaller_picture():
    trunk, pictures = keypoint_trunk().eval(), torch.rand(2, 3, 224, 224)
    smaller = torch.nn.functional.interpolate(pictures, (112, 112), mode="area")
    torch.testing.assert_close(trunk(pictures), trunk(smaller))


def test_pictures_need_beliefs(tmp_path):
    with pytest.raises(FileNotFoundError, match="no beliefs in"):
        next(draw_all(tmp_path))


@pytest.fixture(scope="module")
def readings():
    """Three demos of an arm at a constant rate, read without bias: a filter must follow."""
    torch.manual_seed(0)
    motion = ArmMotion(FACTS)
    motion.damping.data.fill_(12.0)  # rates last
    state = torch.cat([states(3), 0.01 * torch.randn(3, 7)], -1)
    path = [state]
    with torch.no_grad():
        state[:, 7:10] = motion.place(state[:, :7])
        for _ in range(39):
            path.append(motion(path[-1]))
    path = torch.stack(path, 1)
    sensor = SENSORS["keypoints"].build(FACTS, 32)
    samples = TurnedWrist()(path[..., :10]).unsqueeze(-2) + 0.01 * torch.randn(3, 40, MEMBERS, 11)
    encoding = torch.zeros(3, 40, 64)
    td = TensorDict({"state": path[..., :10], "motion": path, "action": path[..., :7]}, [3, 40])
    td["sensor"] = TensorDict({"ensemble": samples, "encoding": encoding}, [3, 40])
    td["observed"] = torch.ones(3, 40, 1, dtype=torch.bool)
    return sensor, motion, td


@pytest.mark.parametrize("name", sorted(FILTERS))
def test_every_filter_carries_the_table_first_and_follows_a_sensor_that_is_right(name, readings):
    sensor, motion, td = readings
    kind = FILTERS[name]
    own = ArmMotion(FACTS, actions=True) if kind.actions else motion
    torch.manual_seed(0)
    recipe = kind(copy.deepcopy(sensor), SENSORS["keypoints"], FACTS, own, ERRORS)
    model = recipe.build()
    out = run_filter(recipe, model, td)
    assert out["belief", "mean"].shape[-1] >= 10
    assert torch.isfinite(out["belief", "mean"]).all()
    if name in ("dekf", "dukf", "bkf", "denkf", "adenkf"):  # the others must be trained first
        scores = errors(out["belief", "mean"][..., :10], td["state"])
        assert scores["joint_mae_deg"] < 2.0, scores  # the start is 1 to 3 degrees off, in rates, too
    wide = copy.deepcopy(model)
    recipe.set_inflation(wide, 1.5)
    tempered = run_filter(recipe, wide, td)
    if ("belief", "log_weight") in out.keys(True):  # more of the particles count
        less, more = (each["belief", "log_weight"][:, 10:].mul(2).logsumexp(-1).mean() for each in (tempered, out))
        assert less < more
    if name != "dpf_m_lrn":  # whose likelihood, untrained, does not prefer what is near
        spread = [float(each["belief", "var"][:, 10:, :10].log().mean()) for each in (out, tempered)]
        assert spread[1] > spread[0]


def test_localisation_keeps_covariances_and_the_gripper_apart():
    state, reading = localisation(27)
    assert torch.linalg.eigvalsh(reading).min() > -1e-6  # its product with a covariance is one (Schur)
    assert torch.equal(state[17:], reading)  # biases
    assert torch.equal(state[:7], state[10:17])  # rates go with their joints
    gripper = [6, 16, 23]
    arm = [index for index in range(27) if index not in gripper]
    assert (state[arm, 6] == 0).all()
    assert (state[gripper][:, [0, 1, 2, 3, 4, 5, 7, 8, 9]] == 0).all()
    assert (state[gripper, 6] == 1).all()
    assert torch.equal(localisation(17)[0], state[:17])


def test_a_head_on_features_is_the_sensor_on_pictures():
    torch.manual_seed(0)
    sensor = SENSORS["glimpse"].build(FACTS, 5).eval()
    pixels = torch.rand(2, 3, 32, 32)
    codes = TensorDict({"code": sensor.module["trunk"](sensor._prepare(pixels))}, [2])
    sensor.module["head"].sample = False
    whole = sensor(TensorDict({"pixels": pixels}, [2]))
    head = sensor.module["head"].forward(codes["code"], sample=False)
    torch.testing.assert_close(whole["sensor", "ensemble"][:, 0], sensor.loc + sensor.scale * head)
    sensor.module["head"].sample = True
    assert read_head(sensor, codes, 7)["sensor", "ensemble"].shape == (2, 7, 11)


def test_a_belief_at_rest_is_padded():
    from torch_denkf.modules import AroundState

    initial = AtRest(AroundState(torch.zeros(27), ensemble_size=3), size=27)
    state = states(2)
    belief = initial(TensorDict({"state": state}, [2]))["belief", "mean"]
    torch.testing.assert_close(belief, torch.cat([state, torch.zeros(2, 17)], -1))


# ---------------------------------------------------------------------------------------------------------- tables


def test_the_table_keeps_what_it_was_given(tmp_path):
    scores = {"joint_mae_deg": 1.25, "ee_mae_cm": 0.25, "coverage90": 0.9, "ms_per_step": 2.0, "parameters": 7}
    scores |= {f"J{i}_deg": 1.0 for i in range(1, 8)}
    names = {"filter": "denkf", "sensor": "glimpse", "domain": "sim", "training": "sim", "seed": 0, "demos": 43}
    rows = [{**names, **scores, "condition": c, "ensemble_size": 32} for c in ("clean", "black20", "missing")]
    rows[1] |= {"blackout_joint_mae_deg": 2.0, "std_before_deg": 1.0, "std_blind_deg": 3.0, "std_after_deg": 1.1}
    rows.append({**names, **scores, "condition": "clean", "ensemble_size": 8, "joint_mae_deg": 4.5})
    rows[-1]["validation_crps"] = 1.5
    COLUMNS.write(rows, tmp_path / "table.csv")

    def place(row):
        return row["condition"], row["ensemble_size"]

    assert sorted(COLUMNS.read(tmp_path / "table.csv"), key=place) == sorted(rows, key=place)
    assert (tmp_path / "table.csv").read_text().splitlines()[0] == ",".join(COLUMNS.names)
    text = markdown(rows, "header")
    assert "| sim | glimpse | denkf | 1.25 / 0.25 / 90 % |" in text
    assert "| 8 | 1.500 | 4.50 | 0.250 | 90 % | 2.00 |" in text
    assert "| 32 |  | 1.25 | 0.250 | 90 % | 2.00 |" in text
    assert "| sim | sim | glimpse | denkf | 2.00 | 1.00 | 3.00 | 1.10 |" in text
