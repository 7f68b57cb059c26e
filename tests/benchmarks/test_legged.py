"""The study of a legged robot's base: its scores against made-up beliefs, its data, its page."""

import dataclasses
from itertools import product

import pytest
import torch

from benchmarks.common.arguments import ROOT
from benchmarks.legged.start import turned
from benchmarks.legged.study import ICUB, Study, chosen, in_the_air, page, run, scored, still
from benchmarks.legged.task import FIRM, GROUNDS, ROWS, SIMULATED, base_pose, icub, scores, simulated
from benchmarks.legged.training import LASTS, LSTM, learned_contacts
from tests.real_data import SHARED
from torch_denkf.applications.legged import LearnedContacts, LeggedNoises
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.applications.legged.motion import LeggedSpace
from torch_denkf.applications.legged.readings import FeetInBody
from torch_denkf.functional.manifolds import SO3, rotate


@pytest.fixture(scope="module")
def robot():
    return simulated("quadruped", 2, 1.5, 0, FIRM)


def true_mean(robot):
    """A belief that holds the truth, of the sensor on the base; feet are zero."""
    true, sensor = robot.log["true"], LegKinematics(robot.model, **robot.names).base
    turn = SO3().compose(true["orientation"], sensor[:4].expand_as(true["orientation"]))
    place = true["position"] + rotate(true["orientation"], sensor[4:])
    zero = torch.zeros_like(place)
    return torch.cat([turn, zero, place, zero, zero, zero, zero, zero, zero], -1)


def test_the_truth_has_no_error(robot):
    mean, velocity = true_mean(robot), robot.log["true", "velocity"]
    turn, place = base_pose(robot, mean)
    assert SO3().distance(turn, robot.log["true", "orientation"]).max() < 1e-3
    assert (place - robot.log["true", "position"]).abs().max() < 1e-5
    found = scores(robot, velocity, torch.ones_like(velocity), mean)
    assert found["velocity"] == found["nees"] == 0
    assert found["held"] == 1
    assert found["tilt"] < 0.1
    assert found["drift"] < 0.01


def test_errors_are_counted(robot):
    torch.manual_seed(0)
    velocity = robot.log["true", "velocity"]
    std = torch.tensor([0.1, 0.2, 0.3])
    found = scores(robot, velocity + std * torch.randn_like(velocity), std.square().expand_as(velocity))
    assert found["velocity"] == pytest.approx(0.14**0.5, rel=0.1)
    assert found["nees"] == pytest.approx(1, rel=0.15)
    assert found["held"] == pytest.approx(0.9, abs=0.05)
    too_sure = scores(robot, velocity + std * torch.randn_like(velocity), (std / 2).square().expand_as(velocity))
    assert too_sure["nees"] == pytest.approx(4, rel=0.15)


def test_a_turned_belief_tilts_and_drifts(robot):
    mean = true_mean(robot)
    turn = SO3().exp(torch.tensor([0.1, 0.0, 0.0]))
    mean[..., :4] = SO3().compose(turn.expand(*mean.shape[:-1], 4), mean[..., :4])
    velocity = robot.log["true", "velocity"]
    assert scores(robot, velocity, torch.ones_like(velocity), mean)["tilt"] == pytest.approx(5.73, rel=0.02)
    # What begins elsewhere, with another heading, does not drift: the way counts from there.
    heading = SO3().exp(torch.tensor([0.0, 0.0, 1.0]))
    moved = true_mean(robot)
    moved[..., :4] = SO3().compose(heading.expand(*moved.shape[:-1], 4), moved[..., :4])
    moved[..., 7:10] = rotate(heading, moved[..., 7:10]) + 3
    found = scores(robot, velocity, torch.ones_like(velocity), moved)
    assert found["drift"] < 0.01
    assert found["tilt"] < 0.1


def test_runs_differ_and_repeat(robot):
    again = simulated("quadruped", 2, 1.5, 0, FIRM)
    assert torch.equal(robot.log["imu"], again.log["imu"])
    assert (robot.log["imu"][0] - robot.log["imu"][1]).abs().max() > 0.1
    slippery = simulated("quadruped", 1, 1.0, 0, list(GROUNDS.values())[1])
    assert slippery.log["last", "imu"].shape == (1, 100, 60)


@pytest.mark.slow
def test_without_feet_the_inertial_sensor_is_integrated(robot):
    """Its error grows without bound, and the intervals know it."""
    walks = scored(robot, run(robot, kind="EKF")[0])
    belief, _ = run(in_the_air(robot), kind="EKF")
    flies = scored(robot, belief)
    assert flies["velocity"] > walks["velocity"]
    var = belief["velocity_var"].sum(-1)[0]
    assert (var[60:].diff() > 0).all()
    assert still(robot)["velocity"] > walks["velocity"]


def test_the_lstm_reads_what_the_contacts_read_of_one_row(robot):
    contacts = LearnedContacts(robot.model, **robot.names, rows=ROWS)
    features = LSTM(contacts).read(robot.log)
    last = contacts.features(*(robot.log["last", key] for key in ("imu", "joints", "joint_rates", "contact")))
    assert torch.equal(features.unflatten(-1, (4, 16)), last[..., -16:])


@pytest.mark.slow
def test_how_long_errors_of_contacts_last_is_chosen_in_validation(robot):
    short = dataclasses.replace(robot, log=robot.log[:, :40], doubtful=robot.doubtful[:, :40], rows=slice(10, None))
    noises = LeggedNoises(kinematics=0.03, rate=1.0)
    contacts = learned_contacts(short, short, noises, 5, 32)
    chosen_rows, found = contacts.lasts.item(), {}
    for lasts in LASTS:
        contacts.lasts.fill_(lasts)
        found[lasts] = scored(short, run(short, kind="EKF", noises=noises, contacts=contacts)[0])["nees"]
    assert chosen_rows == next((lasts for lasts in LASTS if found[lasts] <= 1), LASTS[-1])


def test_the_page_has_every_row():
    noises = {"kinematics": 0.7, "rate": 1.0, "gyro": 1.0, "accelerometer": 1.0}
    rows = [
        {"data": d, "filter": "EKF", "velocity": 0.1, "certain": 0.2, **noises} for d in ("humanoid, firm ground", ICUB)
    ]
    text = page(rows, Study())
    assert "| EKF | 0.100 |  |" in text
    assert "| EKF | 0.100 | 0.200 |" in text
    assert "| iCub | 0.7 | 1 |" in text
    assert "| humanoid | 0.7 | 1 |" in text


@pytest.mark.slow
def test_the_likeliest_noises_are_chosen_once(robot, tmp_path):
    grid = [{"kinematics": k, "rate": r, "gyro": 1e-3, "accelerometer": 5e-3} for k, r in ((0.01, 0.3), (1e-4, 1e-3))]
    assert chosen(lambda: robot, "some", grid, tmp_path).kinematics == 0.01
    assert chosen(None, "some", grid, tmp_path).kinematics == 0.01, "nothing is run again"


def test_the_results_are_those_of_the_study():
    table = (ROOT / "benchmarks/legged/results/legged.md").read_text()
    assert "python -m benchmarks.legged --out benchmarks/legged/results`" in table
    for kind, name in product(SIMULATED, GROUNDS):
        assert f"## {kind}, {name}" in table
    assert [field.name for field in dataclasses.fields(Study)][-1] == "smoke"


@pytest.mark.skipif(not (SHARED / "icub").exists(), reason="the log is not here")
def test_of_the_walk_the_truth_is_in_doubt_where_a_loaded_foot_moves():
    robot = icub(SHARED / "icub")
    assert 0 < robot.doubtful.double().mean() < 0.5
    assert robot.log.shape == robot.doubtful.shape


def test_a_turned_world_looks_the_same_to_its_feet():
    torch.manual_seed(0)
    state, turn = torch.randn(5, 28), SO3().exp(torch.randn(5, 3))
    state[:, :4] = SO3().exp(torch.randn(5, 3))
    seen = FeetInBody(LeggedSpace(4)).compute(state.unsqueeze(-2))
    moved = turned(state, turn)
    assert (FeetInBody(LeggedSpace(4)).compute(moved.unsqueeze(-2)) - seen).abs().max() < 1e-5
    assert (rotate(turn, state[:, 4:7]) - moved[:, 4:7]).abs().max() < 1e-6
