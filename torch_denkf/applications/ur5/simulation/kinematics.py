"""Inverse kinematics and minimum-jerk paths of the UR5 at the table."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torch_denkf.applications.ur5.simulation.scene import UR5Scene

__all__ = ["Unreachable", "Waypoint", "inverse_kinematics", "minimum_jerk", "plan_path", "tool_down"]

# Elbow up, tool down, in front of the base: where every search for joints starts.
READY = np.array([0.0, -1.9, 2.0, -1.67, -np.pi / 2, 0.0])
# Chebyshev nodes on [0, 1]: the joints along a segment are the polynomial through the solutions at these.
NODES = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, 6))


class Unreachable(ValueError):
    """Raised if a pose or path is out of the arm's reach."""


@dataclass
class Waypoint:
    """Next pose of the pinch point: m from the table's centre, quaternion, J7 in rad, control steps it takes."""

    position: np.ndarray
    rotation: np.ndarray
    opening: float
    steps: int


def minimum_jerk(tau: np.ndarray) -> np.ndarray:
    """Returns the share of the way at the share ``tau`` of the time, at rest at its ends (Flash and Hogan 1985)."""
    return tau**3 * (10 - 15 * tau + 6 * tau**2)


def tool_down(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Returns the quaternion of a tool that points down, tilted about the fingers' way (pitch) and across (roll)."""
    out = np.array([0.0, 1.0, 0.0, 0.0])  # half a turn about x: z down
    for angle, axis in ((roll, (0, 1, 0)), (pitch, (1, 0, 0)), (yaw, (0, 0, 1))):
        turn, product = np.empty(4), np.empty(4)
        mujoco.mju_axisAngle2Quat(turn, np.array(axis, float), angle)
        mujoco.mju_mulQuat(product, turn, out)
        out = product
    return out


def inverse_kinematics(
    scene: UR5Scene, position: np.ndarray, rotation: np.ndarray, start: np.ndarray, *, iterations: int = 60
) -> np.ndarray:
    """Returns joints ``[6]`` that bring the pinch point to a pose: damped least squares on the site's Jacobian.

    Args:
        scene: whose ``scratch`` data is used.
        position: m from the table's centre.
        rotation: quaternion w, x, y, z.
        start: rad, where to start; the solution is on its branch.
        iterations: after which the pose counts as out of reach.

    Raises:
        Unreachable: if the error stays above 0.1 mm or 0.1 mrad.
    """
    model, data = scene.model, scene.scratch
    data.qpos[:] = scene.data.qpos
    joints = np.array(start[:6], dtype=float)
    jacobian, error = np.zeros((6, model.nv)), np.zeros(6)
    present, inverse, difference = np.empty(4), np.empty(4), np.empty(4)
    for _ in range(iterations):
        data.qpos[scene.arm_qpos] = joints
        mujoco.mj_kinematics(model, data)
        error[:3] = position + data.site_xpos[scene.centre] - data.site_xpos[scene.pinch]
        mujoco.mju_mat2Quat(present, data.site_xmat[scene.pinch])
        mujoco.mju_negQuat(inverse, present)
        mujoco.mju_mulQuat(difference, rotation, inverse)
        mujoco.mju_quat2Vel(error[3:], difference, 1.0)
        if np.abs(error).max() < 1e-4:
            return joints
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], scene.pinch)
        J = jacobian[:, scene.arm_dofs]
        step = J.T @ np.linalg.solve(J @ J.T + 1e-5 * np.eye(6), error)
        joints += step * min(1.0, 0.4 / np.abs(step).max())
    raise Unreachable(f"no joints bring the tool to {np.round(position, 3)} m from the table's centre")


def plan_path(scene: UR5Scene, start: np.ndarray, waypoints: list[Waypoint], steps: int) -> np.ndarray:
    """Plans joint targets ``[steps, 7]`` from the joints ``start`` through the waypoints; holds the last one.

    Each segment is a straight line of the pinch point with a turn at an even rate, at minimum jerk in time.

    Raises:
        Unreachable: if a segment leaves the arm's reach, or the arm would turn over on the way.
    """
    data = scene.posed(scene.pose_with(start))
    position, rotation = data.site_xpos[scene.pinch] - data.site_xpos[scene.centre], np.empty(4)
    mujoco.mju_mat2Quat(rotation, data.site_xmat[scene.pinch])
    joints, opening = start[:6], start[6]
    rows = []
    for waypoint in waypoints:
        share = minimum_jerk(np.arange(1, waypoint.steps + 1) / waypoint.steps)
        nodes = [joints]
        for node in NODES[1:]:
            where = position + node * (waypoint.position - position)
            turned = _slerp(rotation, waypoint.rotation, node)
            nodes.append(inverse_kinematics(scene, where, turned, nodes[-1], iterations=25))
        solutions = np.array(nodes)
        if np.abs(np.diff(solutions, axis=0)).max() > 1.2:
            raise Unreachable("the arm would turn over on the way")
        powers = np.arange(len(NODES))
        weights = share[:, None] ** powers @ np.linalg.inv(NODES[:, None] ** powers)
        rows.append(np.column_stack([weights @ solutions, opening + share * (waypoint.opening - opening)]))
        position, rotation, joints, opening = waypoint.position, waypoint.rotation, solutions[-1], waypoint.opening
    path = np.concatenate(rows)[:steps]
    return np.concatenate([path, np.repeat(path[-1:], steps - len(path), axis=0)])


def _slerp(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    inverse, difference, velocity, out = np.empty(4), np.empty(4), np.empty(3), start.copy()
    mujoco.mju_negQuat(inverse, start)
    mujoco.mju_mulQuat(difference, inverse, end)
    mujoco.mju_quat2Vel(velocity, difference, 1.0)  # in the tool's frame, which is where mju_quatIntegrate wants it
    mujoco.mju_quatIntegrate(out, velocity, share)
    return out
