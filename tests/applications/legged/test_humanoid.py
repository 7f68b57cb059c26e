"""The humanoid in its harness: it walks on its own legs, goes where the harness goes, and a filter follows it."""

import math

import pytest
import torch

from tests.applications.legged.test_environment import PERFECT
from torch_denkf.applications.legged import legged_filter
from torch_denkf.applications.legged.humanoid import HUMANOID, humanoid_env, stroll
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.functional.manifolds import SO3, rotate


def walking(env, steps, **gait):
    td, rows = env.reset(), []
    for step in range(steps):
        begun = min(1.0, step * env.dt)
        td["action"] = stroll(step * env.dt, stride=0.2 * begun, lift=0.4 * begun, **gait)
        td = env.step(td)["next"]
        rows.append(td.exclude("done", "terminated", "truncated", "reward"))
    return torch.stack(rows)


@pytest.fixture(scope="module")
def log():
    return walking(humanoid_env(PERFECT, speed=0.5, turn=0.2), 400).double()


def test_it_walks_upright_on_its_own_legs(log):
    late = log[100:]
    weight = humanoid_env().model.body_mass.sum() * 9.81
    assert late["force"].sum(-1).mean() == pytest.approx(weight, rel=0.1), "the harness carries little"
    up = rotate(late["true", "orientation"], torch.tensor([0.0, 0.0, 1.0]).double())
    assert up[:, 2].min() > 0.95
    assert late["true", "velocity"][:, 0].mean() == pytest.approx(0.5, abs=0.1)
    stands = late["contact"].double()
    assert (stands.diff(dim=0) > 0).sum(0).tolist() == pytest.approx([3, 3], abs=1), "a stride a second"
    assert stands.any(-1).double().mean() > 0.95, "one foot stands"
    turn = late["true", "orientation"]
    heading = 2 * torch.atan2(turn[:, 3], turn[:, 0])
    assert heading[-1] - heading[0] == pytest.approx(0.2 * 3, abs=0.15)


def test_standing_feet_rest(log):
    """By the base's true velocity, the gyro and the joints: .1 m/s, where the base has .5 and a swinging foot 1.5."""
    kinematics = LegKinematics(humanoid_env().model, **HUMANOID).double()
    sensor, gyro = kinematics.base, log["imu"][:, None, :3]
    to_sensor = SO3().inverse(sensor[:4])
    velocity = rotate(to_sensor, log["true", "velocity"]).unsqueeze(1)
    feet = kinematics(log["joints"]) + rotate(to_sensor, sensor[4:])
    moves = velocity + torch.linalg.cross(gyro.expand_as(feet), feet)
    moves = (moves + kinematics.velocities(log["joints"], log["joint_rates"])).norm(dim=-1)[100:]
    stands = log["contact"][100:] > 0
    assert moves[stands].square().mean().sqrt() < 0.15
    assert moves[~stands].square().mean().sqrt() > 0.5


def test_the_sensor_feels_the_harness(log):
    """What it reads leads where the base goes, though forces from outside act: in one second to a few cm."""
    sensor = LegKinematics(humanoid_env().model, **HUMANOID).base.double()
    turn = SO3().compose(log["true", "orientation"], sensor[:4].expand(400, 4))
    world = rotate(turn, log["imu"][:, 3:]) - torch.tensor([0, 0, 9.81]).double()
    place = log["true", "position"] + rotate(log["true", "orientation"], sensor[4:])
    change = (place[200:] - place[100:-100]) / 1.0
    velocity = place.diff(dim=0) / 0.01
    # x(t + 1) - x(t) - v(t) = the integral of (t + 1 - s) a(s): integration by parts of the readings.
    weights = (torch.arange(100, 0, -1).double() - 0.5) * 1e-4
    by_readings = torch.stack([(weights.unsqueeze(-1) * world[row + 1 : row + 101]).sum(0) for row in range(100, 300)])
    assert (change - velocity[99:299] - by_readings).norm(dim=-1).max() < 0.06


@pytest.mark.parametrize("kind", ["EKF", "DEnKF"])
def test_a_filter_follows_it(kind):
    env = humanoid_env(seed=1)
    log = walking(env, 200).unsqueeze(0)
    filter = legged_filter(env.model, **HUMANOID, dt=env.dt, kind=kind, ensemble_size=48)
    torch.manual_seed(0)
    with torch.no_grad():
        out = filter.sequence(log.clone())
    true = log["true", "velocity"][:, 50:]
    error = (out["belief", "velocity"][:, 50:] - true).square().sum(-1).mean().sqrt()
    assert error < 0.4 * true.square().sum(-1).mean().sqrt()
    assert math.isfinite(out["belief", "velocity_var"].sum())
