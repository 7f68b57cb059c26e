"""Pick, push and put-down: what is drawn for an episode, the expert's way through it, and when it has succeeded."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from torch_denkf.applications.ur5.simulation.kinematics import (
    READY,
    Unreachable,
    Waypoint,
    inverse_kinematics,
    plan_path,
    tool_down,
)
from torch_denkf.applications.ur5.simulation.names import TASKS, TaskName
from torch_denkf.applications.ur5.simulation.scene import FINGER_TRAVEL, FULL_OPENING, UR5Scene

__all__ = ["TASKS", "Episode", "draw_episode", "succeeded"]

COLOURS = np.array([[0.85, 0.2, 0.15], [0.15, 0.35, 0.8], [0.9, 0.7, 0.1], [0.5, 0.2, 0.6], [0.1, 0.55, 0.55]])
LOWEST = 0.021  # m: below it the tips of a tilted gripper touch the table
TILT = 0.3  # rad: a tool that always points straight down would leave wrist_2 where it is


@dataclass
class Episode:
    """One episode: metres from the table's centre, radian, quaternions w, x, y, z."""

    kind: str
    half_size: np.ndarray
    colour: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    joints: np.ndarray
    goal: np.ndarray
    path: np.ndarray


def draw_episode(scene: UR5Scene, task: TaskName, rng: np.random.Generator, steps: int, attempts: int = 100) -> Episode:
    """Draws object, home pose, tool tilts and pace until the arm reaches all of the expert's way.

    Raises:
        Unreachable: after that many attempts.
    """
    for _ in range(attempts):
        try:
            return _DRAW[task](scene, rng, steps)
        except Unreachable:
            continue
    raise Unreachable(f"none of {attempts} draws of the task {task!r} lies within the arm's reach")


def succeeded(scene: UR5Scene, task: TaskName, episode: Episode) -> bool:
    """Returns True for a pick by 8 cm, a push to 3 cm from the goal, a put-down so, standing, the gripper 7 cm away."""
    position, height = scene.object_position(), episode.half_size[2]
    if task == "pick":
        return bool(position[2] - height > 0.08)
    there = np.linalg.norm(position[:2] - episode.goal[:2]) < 0.03
    standing = abs(position[2] - height) < 0.005 and scene.object_upright() > 0.98
    if task == "push":
        return bool(there and standing)
    away = np.linalg.norm(scene.state()[7:] - position) > 0.07
    return bool(there and standing and away)


# ------------------------------------------------------------------------------------------------- what is drawn


def _object(
    rng: np.random.Generator, low: float, high: float, tallest: float = 0.035
) -> tuple[str, np.ndarray, np.ndarray]:
    kind, width = ("box", "cylinder")[rng.integers(2)], rng.uniform(low, high)
    colour = np.clip(COLOURS[rng.integers(len(COLOURS))] + rng.uniform(-0.08, 0.08, 3), 0, 1)
    return kind, np.array([width, width, rng.uniform(0.02, tallest)]), colour


def _place(rng: np.random.Generator) -> np.ndarray:
    return np.array([rng.uniform(-0.12, 0.18), rng.uniform(-0.25, 0.25), 0.0])


def _free_pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    position = np.array([rng.uniform(-0.2, 0.1), rng.uniform(-0.28, 0.28), rng.uniform(0.2, 0.38)])
    pitch, roll = rng.uniform(-TILT, TILT, 2)
    return position, tool_down(rng.uniform(-1.0, 1.0), pitch, roll)


def _home(scene: UR5Scene, rng: np.random.Generator, opening: float) -> np.ndarray:
    position, rotation = _free_pose(rng)
    start = READY.copy()
    # The arm's plane lies 109 mm next to the base's axis.
    x, y = position[0] + 0.55, position[1]
    start[0] = np.arctan2(y, x) - np.arcsin(min(0.9, 0.109 / np.hypot(x, y)))
    return np.append(inverse_kinematics(scene, position, rotation, start), opening)


def _grasp(rng: np.random.Generator, kind: str, yaw: float) -> np.ndarray:
    """Returns a tool that closes on the object; a box is taken by one of its two pairs of sides."""
    if kind == "box":
        turned = (yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
        turned -= np.sign(turned) * rng.integers(2) * np.pi / 2
    else:
        turned = rng.uniform(-np.pi / 2, np.pi / 2)
    return tool_down(turned, rng.uniform(-TILT, TILT), rng.uniform(-0.06, 0.06))


def _upright(yaw: float) -> np.ndarray:
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def _paced(rng: np.random.Generator, waypoints: list[Waypoint]) -> list[Waypoint]:
    """Draws the pace: the arm's segments take 320 to 345 steps (26 to 28 s) together with the gripper's 20."""
    moving = [w for w in waypoints if w.steps]
    shares = np.array([w.steps for w in moving]) * rng.uniform(0.8, 1.25, len(moving))
    grip = 20 * (len(waypoints) - len(moving))
    for waypoint, steps in zip(moving, shares / shares.sum() * (rng.integers(320, 346) - grip), strict=True):
        waypoint.steps = int(steps)
    for waypoint in waypoints:
        waypoint.steps = waypoint.steps or 20  # slowly: the opening is a state that a filter follows
    return waypoints


def _raised(position: np.ndarray, height: float) -> np.ndarray:
    return position + np.array([0.0, 0.0, height])


def _pick(scene: UR5Scene, rng: np.random.Generator, steps: int) -> Episode:
    kind, half_size, colour = _object(rng, 0.016, 0.027)
    yaw, place, opening = rng.uniform(-np.pi, np.pi), _place(rng), rng.uniform(0.68, FULL_OPENING)
    home = _home(scene, rng, rng.uniform(0.0, FULL_OPENING))
    grasp = _grasp(rng, kind, yaw)
    low = _raised(place, max(half_size[2], LOWEST))
    waypoints = [
        Waypoint(_raised(low, rng.uniform(0.09, 0.14)), grasp, opening, 70),
        Waypoint(low, grasp, opening, 45),
        Waypoint(low, grasp, 0.0, 0),
        Waypoint(_raised(low, rng.uniform(0.13, 0.2)), grasp, 0.0, 50),
        Waypoint(*_free_pose(rng), 0.0, 70),
        Waypoint(*_free_pose(rng), 0.0, 70),
    ]
    path = plan_path(scene, home, _paced(rng, waypoints), steps)
    goal = _raised(low, 0.08)
    position = _raised(place, half_size[2])
    return Episode(kind, half_size, colour, position, _upright(yaw), home, goal, path)


def _push(scene: UR5Scene, rng: np.random.Generator, steps: int) -> Episode:
    kind, half_size, colour = _object(rng, 0.023, 0.03, tallest=0.028)  # what is tall and narrow topples
    course, place = rng.uniform(-np.pi, np.pi), _place(rng)
    way = np.array([np.cos(course), np.sin(course), 0.0])
    goal = place + rng.uniform(0.1, 0.2) * way
    if not (-0.14 < goal[0] < 0.2 and abs(goal[1]) < 0.27):
        raise Unreachable("the goal lies off the part of the table that the arm reaches")
    yaw = course + rng.uniform(-0.25, 0.25)
    # The shut fingers' broad side pushes: a cylinder would wedge itself into a gap between them, and come back along.
    across = course % np.pi - np.pi / 2
    tool = tool_down(across, rng.uniform(-0.18, 0.18), rng.uniform(-0.12, 0.12))
    home = _home(scene, rng, rng.uniform(0.0, FULL_OPENING))
    touch = half_size[0] * (1.2 if kind == "box" else 1.0) + 0.012
    behind = _raised(place - (touch + rng.uniform(0.03, 0.05)) * way, LOWEST + 0.002)
    ahead = _raised(goal - (half_size[0] + 0.012) * way, LOWEST + 0.002)
    waypoints = [
        Waypoint(_raised(behind, rng.uniform(0.1, 0.15)), tool, 0.0, 70),
        Waypoint(behind, tool, 0.0, 45),
        Waypoint(ahead, tool, 0.0, 80),
        Waypoint(ahead - 0.03 * way, tool, 0.0, 25),
        Waypoint(_raised(ahead - 0.03 * way, rng.uniform(0.12, 0.18)), tool, 0.0, 50),
        Waypoint(*_free_pose(rng), rng.uniform(0.0, FULL_OPENING), 70),
    ]
    path = plan_path(scene, home, _paced(rng, waypoints), steps)
    position, goal = _raised(place, half_size[2]), _raised(goal, half_size[2])
    return Episode(kind, half_size, colour, position, _upright(yaw), home, goal, path)


def _put_down(scene: UR5Scene, rng: np.random.Generator, steps: int) -> Episode:
    kind, half_size, colour = _object(rng, 0.016, 0.027)
    yaw, goal = rng.uniform(-np.pi, np.pi), _place(rng)
    hold = _grasp(rng, kind, yaw)  # also the way it was taken: it stands upright when the tool is turned like this
    home = _home(scene, rng, half_size[0] / FINGER_TRAVEL * FULL_OPENING + 0.01)
    low = _raised(goal, max(half_size[2], LOWEST) + 0.001)
    opening = rng.uniform(0.68, FULL_OPENING)
    waypoints = [
        Waypoint(*_free_pose(rng), 0.0, 70),
        Waypoint(_raised(low, rng.uniform(0.09, 0.14)), hold, 0.0, 70),
        Waypoint(low, hold, 0.0, 50),
        Waypoint(low, hold, opening, 0),
        Waypoint(_raised(low, rng.uniform(0.1, 0.15)), hold, opening, 50),
        Waypoint(*_free_pose(rng), rng.uniform(0.0, FULL_OPENING), 70),
    ]
    # The first targets already press: the fingers have closed on the object before the episode begins.
    path = plan_path(scene, np.append(home[:6], 0.0), _paced(rng, waypoints), steps)
    position, rotation = _in_hand(scene, home, hold, half_size, _upright(yaw))
    goal = _raised(goal, half_size[2])
    return Episode(kind, half_size, colour, position, rotation, home, goal, path)


def _in_hand(scene: UR5Scene, joints: np.ndarray, hold: np.ndarray, half_size: np.ndarray, upright: np.ndarray):
    """Returns the pose of the object held at these joints, ``upright`` if the tool is turned by ``hold``."""
    data = scene.posed(scene.pose_with(joints))
    tool, back, turn, rotation, offset = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(3)
    mujoco.mju_mat2Quat(tool, data.site_xmat[scene.pinch])
    mujoco.mju_negQuat(back, hold)
    mujoco.mju_mulQuat(turn, tool, back)
    mujoco.mju_mulQuat(rotation, turn, upright)
    below = np.array([0.0, 0.0, half_size[2] - max(half_size[2], LOWEST)])  # the object's centre from the pinch point
    mujoco.mju_rotVecQuat(offset, below, turn)
    return data.site_xpos[scene.pinch] - data.site_xpos[scene.centre] + offset, rotation


_DRAW = dict(zip(TASKS, (_pick, _push, _put_down), strict=True))
