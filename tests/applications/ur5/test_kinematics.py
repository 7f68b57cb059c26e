"""Oracles: the product of UR5 Denavit-Hartenberg matrices, finite differences, the minimum-jerk polynomial."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from torch_denkf.applications.ur5.simulation.kinematics import (
    READY,
    Unreachable,
    Waypoint,
    inverse_kinematics,
    minimum_jerk,
    plan_path,
    tool_down,
)
from torch_denkf.applications.ur5.simulation.scene import UR5Scene

# Universal Robots, "DH parameters for calculations of kinematics and dynamics": UR5 (CB3).
A = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)
D = (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823)
ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)
BASE, PINCH = np.array([-0.55, 0.0, 0.0]), 0.16


@pytest.fixture(scope="module")
def scene():
    return UR5Scene()


def flange(joints):
    """Returns the flange in the table's frame; the maker's base frame has its x axis away from the table."""
    pose = np.diag([-1.0, -1.0, 1.0, 1.0])
    pose[:3, 3] = BASE
    for q, a, d, alpha in zip(joints, A, D, ALPHA, strict=True):
        c, s, ca, sa = np.cos(q), np.sin(q), np.cos(alpha), np.sin(alpha)
        pose = pose @ [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
    return pose


def tool(scene, joints):
    data = scene.posed(scene.pose_with(np.append(joints, 0.4)))
    return data.site("pinch").xpos.copy(), data.site("pinch").xmat.reshape(3, 3).copy(), data


def test_forward_kinematics_is_that_of_the_makers_parameters(scene):
    rng = np.random.default_rng(0)
    for joints in rng.uniform(-np.pi, np.pi, (50, 6)):
        expected = flange(joints)
        position, rotation, data = tool(scene, joints)
        np.testing.assert_allclose(data.site("flange").xpos, expected[:3, 3], atol=1e-6)
        np.testing.assert_allclose(rotation, expected[:3, :3], atol=1e-6)
        np.testing.assert_allclose(position, expected[:3, 3] + PINCH * expected[:3, 2], atol=1e-6)
        np.testing.assert_allclose(scene.state(data)[7:], position, atol=1e-12)  # the centre is the origin


def test_inverse_kinematics(scene):
    rng = np.random.default_rng(1)
    for _ in range(20):
        goal, pitch, roll, yaw = rng.uniform([-0.12, -0.2, 0.05], [0.15, 0.2, 0.3]), *rng.uniform(-0.3, 0.3, 3)
        joints = inverse_kinematics(scene, goal, tool_down(yaw, pitch, roll), READY)
        position, rotation, _ = tool(scene, joints)
        np.testing.assert_allclose(position, goal, atol=1.1e-4)
        expected = Rotation.from_euler("ZXY", [yaw, pitch, roll]).as_matrix() @ np.diag([1.0, -1.0, -1.0])
        np.testing.assert_allclose(rotation, expected, atol=1.1e-4)
    with pytest.raises(Unreachable, match=r"\[2. 0. 0.\] m from the table's centre"):
        inverse_kinematics(scene, np.array([2.0, 0.0, 0.0]), tool_down(0.0), READY)


def test_minimum_jerk():
    # Rest at both ends, and the constant sixth derivative of a quintic: 15/8 is the known peak speed, at half time.
    tau = np.linspace(0, 1, 20_001)
    speed = np.gradient(minimum_jerk(tau), tau)
    assert minimum_jerk(np.array([0.0, 0.5, 1.0])).tolist() == [0.0, 0.5, 1.0]
    assert abs(speed[0]) < 1e-6 > abs(speed[-1])
    assert speed.max() == pytest.approx(15 / 8, abs=1e-6)
    assert tau[speed.argmax()] == pytest.approx(0.5, abs=1e-3)


def test_path_is_straight_and_ends_at_the_target(scene):
    start = np.append(inverse_kinematics(scene, np.array([-0.1, 0.1, 0.3]), tool_down(0.2, 0.2), READY), 0.8)
    waypoints = [
        Waypoint(np.array([0.1, -0.1, 0.1]), tool_down(-0.5, 0.1), 0.8, 60),
        Waypoint(np.array([0.1, -0.1, 0.1]), tool_down(-0.5, 0.1), 0.2, 20),
    ]
    path = plan_path(scene, start, waypoints, 100)
    assert path.shape == (100, 7)
    where = np.stack([tool(scene, joints[:6])[0] for joints in path])
    share = minimum_jerk(np.arange(1, 61) / 60)[:, None]
    line = np.array([-0.1, 0.1, 0.3]) + share * np.array([0.2, -0.2, -0.2])
    np.testing.assert_allclose(where[:60], line, atol=1e-3)  # a polynomial through six poses of the line
    np.testing.assert_allclose(where[60:] - waypoints[0].position, 0, atol=2e-4)
    np.testing.assert_allclose(path[:60, 6], 0.8)
    np.testing.assert_allclose(path[69, 6], 0.5)  # half time
    np.testing.assert_allclose(path[79:, 6], 0.2)
    assert (path[80:] == path[79]).all()
