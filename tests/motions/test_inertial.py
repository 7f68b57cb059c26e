"""Oracles: falling, circles, matrix exponentials; fine steps of Euler; MuJoCo's sensors; a world turned round."""

import math

import mujoco
import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.motions.steps_for_tests import INERTIAL, inertial_state, random_points, step
from torch_denkf.functional.manifolds import SE23, SO3, rotate, rotation_matrix, skew
from torch_denkf.motions import AttitudeMotion, Gravity, InertialMotion
from torch_denkf.motions.inertial import move_inertially

pytestmark = pytest.mark.usefixtures("float64")


def test_at_rest_nothing_moves_whatever_the_attitude():
    pose = torch.cat([random_points(SO3(), 9), torch.zeros(9, 6)], -1).unsqueeze(-2)
    gravity = Gravity(SE23()).observe(pose.squeeze(-2))
    moved = step(InertialMotion(2.0), inertial_state(pose), imu=torch.cat([torch.zeros(9, 3), gravity], -1))
    assert_close(moved, inertial_state(pose), rtol=0, atol=1e-13)


def test_a_body_that_falls():
    pose = torch.tensor([[1.0, 0.0, 0.0, 0.0, 3.0, 0.0, 4.0, 10.0, 20.0, 30.0]])
    spin = torch.tensor([0.0, 0.0, math.pi, 0.0, 0.0, 0.0])
    moved = step(InertialMotion(0.5, gravity=10.0), inertial_state(pose), imu=spin)[0]
    half = math.sqrt(0.5)
    expected = torch.tensor([half, 0.0, 0.0, half, 3.0, 0.0, -1.0, 11.5, 20.0, 30.0 + 2.0 - 1.25])
    assert_close(moved[:10], expected, rtol=0, atol=1e-14)


def test_a_circle_at_constant_speed():
    """With 2 m/s on a radius of 5 m, nose ahead: the force is v^2 / r to the left, and gravity."""
    speed, radius, dt = 2.0, 5.0, 3.0
    pose = torch.tensor([[1.0, 0.0, 0.0, 0.0, speed, 0.0, 0.0, 0.0, 0.0, 7.0]])
    imu = torch.tensor([0.0, 0.0, speed / radius, 0.0, speed**2 / radius, 9.81])
    angle = speed / radius * dt
    cos, sin = math.cos(angle), math.sin(angle)
    moved = step(InertialMotion(dt), inertial_state(pose), imu=imu)[0]
    assert_close(moved[4:7], torch.tensor([speed * cos, speed * sin, 0.0]), rtol=0, atol=1e-14)
    assert_close(moved[7:10], torch.tensor([radius * sin, radius * (1 - cos), 7.0]), rtol=0, atol=1e-14)
    assert_close(rotate(moved[:4], torch.eye(3)[0]), torch.tensor([cos, sin, 0.0]), rtol=0, atol=1e-14)


@pytest.mark.parametrize("turn", [1e-9, 1e-3, 0.09, 0.11, 1.0, 5.0])
def test_turn_and_its_integrals_are_a_matrix_exponential(turn):
    """Exponentiates [[w, f, 0], [0, 0, 1], [0, 0, 0]]: its last two columns hold the integrals of the turn, times f."""
    rate, force = turn * torch.nn.functional.normalize(torch.randn(3), dim=0), torch.randn(3)
    generator = torch.zeros(5, 5)
    generator[:3, :3], generator[:3, 3], generator[3, 4] = skew(rate), force, 1.0
    exact = torch.linalg.matrix_exp(generator)
    moved = move_inertially(SE23().neutral(torch.zeros(())), rate, force, 1.0, 0.0)
    assert_close(rotation_matrix(moved[:4]), exact[:3, :3], rtol=0, atol=1e-12)
    assert_close(moved[4:7], exact[:3, 3], rtol=0, atol=1e-12)
    assert_close(moved[7:], exact[:3, 4], rtol=0, atol=1e-12)


def test_biases_are_subtracted_from_the_readings():
    pose = random_points(SE23(), 4)
    imu, wrong = torch.randn(6), torch.randn(6)
    biased = step(InertialMotion(0.3), inertial_state(pose, wrong[:3].tolist(), wrong[3:].tolist()), imu=imu + wrong)
    assert_close(biased[..., :10], step(InertialMotion(0.3), inertial_state(pose), imu=imu)[..., :10])
    keys = InertialMotion(0.3, gyro_key="gyro", accelerometer_key=("arm", "force"))
    entries = {"gyro": imu[:3], "arm": {"force": imu[3:]}}
    assert step(keys, inertial_state(pose), **entries).equal(step(InertialMotion(0.3), inertial_state(pose), imu=imu))


def test_attitude_is_the_inertial_motions_orientation():
    state, gyro = random_points(INERTIAL, 5, 4), torch.randn(5, 3)
    short = torch.cat([state[..., :4], state[..., 10:13]], -1)
    moved = step(InertialMotion(0.3), state, imu=torch.cat([gyro, torch.randn(5, 3)], -1))
    assert_close(step(AttitudeMotion(0.3), short, gyro=gyro)[..., :4], moved[..., :4], rtol=0, atol=1e-15)


def test_turning_and_moving_the_world_changes_nothing_else():
    """About gravity, and with any constant velocity: the error of a state does not depend on where it is."""
    state, imu = random_points(INERTIAL, 6, 4), torch.randn(6, 6)
    motion = InertialMotion(0.4)
    turn = SO3().exp(torch.tensor([0.0, 0.0, 2.1]))
    speed, place = torch.tensor([1.0, -2.0, 3.0]), torch.tensor([10.0, 20.0, 30.0])

    def elsewhere(state, seconds):
        orientation, velocity, position, biases = state.split([4, 3, 3, 6], -1)
        moved = [rotate(turn, velocity) + speed, rotate(turn, position) + place + speed * seconds]
        return torch.cat([SO3().compose(turn.expand_as(orientation), orientation), *moved, biases], -1)

    there = step(motion, elsewhere(state, 0.0), imu=imu)
    assert_close(there, elsewhere(step(motion, state, imu=imu), 0.4), rtol=0, atol=1e-13)


def test_pose_error_is_linear_and_state_independent():
    """Barrau & Bonnabel 2017, theorems 1 and 2: of two poses with the same biases, exactly, however large it is."""
    motion, imu, error = InertialMotion(0.4), torch.randn(6), 0.4 * torch.randn(9)

    def later(pose, error):
        moved = step(motion, inertial_state(torch.stack([pose, SE23().plus(pose, error)])), imu=imu)[..., :10]
        return SE23().minus(moved[1], moved[0])

    first, second = random_points(SE23()), random_points(SE23())
    assert_close(later(first, error), later(second, error), rtol=0, atol=1e-12)
    assert_close(later(first, 2 * error), 2 * later(first, error), rtol=0, atol=1e-12)


BODY = """
<mujoco>
  <option timestep="{timestep}" integrator="RK4" gravity="0 0 -9.81"/>
  <worldbody>
    <body name="body" pos="1 2 3">
      <freejoint/>
      <inertial pos="0 0 0" mass="1.3" diaginertia="0.01 0.02 0.025"/>
      <site name="imu" pos="{place}" quat="{turn}"/>
    </body>
  </worldbody>
  <sensor>
    <gyro site="imu"/>
    <accelerometer site="imu"/>
    <framequat objtype="site" objname="imu"/>
    <framelinvel objtype="site" objname="imu"/>
    <framepos objtype="site" objname="imu"/>
  </sensor>
</mujoco>
"""


def simulate(seconds, timestep, place="0 0 0", turn="1 0 0 0"):
    """Returns the readings before each of many steps, [N, 6], and the poses [N, 10], of a body that is pushed."""
    model = mujoco.MjModel.from_xml_string(BODY.format(timestep=timestep, place=place, turn=turn))
    data = mujoco.MjData(model)
    data.qvel[:] = [0.5, -0.3, 0.2, 1.0, -2.0, 0.7]
    rows = []
    for _ in range(round(seconds / timestep) + 1):
        t = data.time
        data.xfrc_applied[1, :3] = [math.sin(3 * t), 2 * math.cos(2 * t), 12.0 + math.sin(t)]
        data.xfrc_applied[1, 3:] = [0.03 * math.cos(4 * t), 0.02 * math.sin(5 * t), -0.02 * math.sin(3 * t)]
        mujoco.mj_forward(model, data)
        rows.append(np.array(data.sensordata))
        mujoco.mj_step(model, data)
    rows = torch.tensor(np.array(rows))
    return rows[:, :6], rows[:, 6:]


@pytest.mark.parametrize(
    ("place", "turn"), [("0 0 0", "1 0 0 0"), ("0.1 -0.2 0.3", "0.5 0.5 -0.5 0.5")], ids=["in the middle", "elsewhere"]
)
def test_sensors_of_mujoco_lead_where_mujoco_is(place, turn):
    """Frames and signs. With the mean of readings at a step's ends, the error falls with the square of its length."""
    timestep, seconds = 2e-4, 2.0  # MuJoCo itself is off by .3 mm: it holds the force over a step
    readings, poses = simulate(seconds, timestep, place, turn)
    assert (poses[-1, 4:] - poses[0, 4:]).norm() > 1
    errors = []
    for every in (400, 200, 100):
        dt = every * timestep
        motion = InertialMotion(dt)
        ends = readings[::every]
        state = inertial_state(poses[:1])
        for imu in (ends[1:] + ends[:-1]) / 2:
            state = step(motion, state, imu=imu)
        error = SE23().minus(state[0, :10], poses[-1])
        errors.append(torch.stack([each.norm() for each in error.split(3)]))
    assert (errors[-1] < torch.tensor([2e-4, 6e-3, 7e-3])).all(), errors
    assert_close(errors[1] / errors[0], torch.full((3,), 0.25), rtol=0.1, atol=0)
    assert_close(errors[2] / errors[1], torch.full((3,), 0.25), rtol=0.1, atol=0)
