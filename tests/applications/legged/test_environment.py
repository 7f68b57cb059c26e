"""Simulated sensors against the true motion, differentiated."""

import pytest
import torch

from torch_denkf.applications.legged import QUADRUPED, LeggedErrors, quadruped_env, trot
from torch_denkf.applications.legged.environment import LeggedEnv
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.functional.manifolds import SO3, rotate

PERFECT = LeggedErrors(*[0.0] * 9)


def trotting(env, steps):
    td, rows = env.reset(), []
    for step in range(steps):
        td["action"] = min(1.0, step * env.dt) * trot(step * env.dt)
        td = env.step(td)["next"]
        rows.append(td.clone())
    return torch.stack(rows)


@pytest.fixture(scope="module")
def log():
    return trotting(quadruped_env(PERFECT), 300).double()


def test_the_sensors_read_how_their_place_moves():
    """Its place is next to the base's origin, turned. With the simulator's own steps: contacts are short."""
    env = LeggedEnv(quadruped_env().model, **QUADRUPED, dt=0.0025, errors=PERFECT)
    log = trotting(env, 800).double()
    sensor = LegKinematics(env.model, QUADRUPED["feet"], QUADRUPED["imu"]).base.double()
    assert sensor[4:].norm() > 0.1
    turn = SO3().compose(log["true", "orientation"], sensor[:4].expand(800, 4))
    place = log["true", "position"] + rotate(log["true", "orientation"], sensor[4:])
    velocity = (place[1:] - place[:-1]) / env.dt
    imu = log["imu"]
    turned = SO3().minus(turn[1:], turn[:-1]) / env.dt
    assert (turned - imu[1:, :3]).abs().max() < 0.02
    # What is read in a step leads to the velocity after it.
    world = rotate(turn, imu[..., 3:]) - torch.tensor([0, 0, 9.81]).double()
    change = (velocity[1:] - velocity[:-1]) / env.dt
    assert (change - world[2:]).square().mean().sqrt() < 0.03 * change.square().mean().sqrt()


def test_contact_forces_carry_the_robot(log):
    weight = quadruped_env().model.body_mass.sum() * 9.81
    assert log["force"].sum(-1).mean() == pytest.approx(weight, rel=0.1)
    assert ((log["force"] > 150) <= log["contact"]).all()
    assert 0.3 < log["contact"].float().mean() < 0.95
    assert (log["true", "position"][-1, :2] - log["true", "position"][0, :2]).norm() > 0.3
