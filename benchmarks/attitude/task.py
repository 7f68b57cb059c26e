"""Logs of inertial sensors with true attitudes: a simulated body that is pushed about, and a humanoid that walks."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.functional.manifolds import SO3, rotate

__all__ = ["DT", "FIELD", "GRAVITY", "Sensors", "simulated", "tilt_error", "walking"]

DT = 0.01  # s, of a row
GRAVITY = 9.81  # m/s^2
FIELD = (0.0, 20.0, -44.0)  # microtesla in the world's axes, x east, y north, z up: as in central Europe
_FINE = 10  # steps of the simulator in a row
_BEARS = 60.0  # N, least load of a standing foot
#: Joints of iCub's log, in its order.
_JOINTS = (
    "neck_pitch neck_roll neck_yaw torso_pitch torso_roll torso_yaw l_shoulder_pitch l_shoulder_roll l_shoulder_yaw "
    "l_elbow r_shoulder_pitch r_shoulder_roll r_shoulder_yaw r_elbow l_hip_pitch l_hip_roll l_hip_yaw l_knee "
    "l_ankle_pitch l_ankle_roll r_hip_pitch r_hip_roll r_hip_yaw r_knee r_ankle_pitch r_ankle_roll"
)


@dataclass(frozen=True)
class Sensors:
    """Errors of a cheap inertial sensor.

    The densities are those of the data sheet of InvenSense's MPU-6050: 0.005 deg/s/sqrt(Hz) and 400 ug/sqrt(Hz). We set
    the rest, with biases as a calibration at another temperature may leave them.
    """

    gyro_noise: float = math.radians(0.005)  # rad/s/sqrt(Hz)
    accelerometer_noise: float = 400e-6 * 9.81  # m/s^2/sqrt(Hz)
    gyro_bias: float = math.radians(0.5)  # rad/s; standard deviation from run to run, like the next
    accelerometer_bias: float = 0.1  # m/s^2
    gyro_walk: float = 5e-5  # rad/s^2/sqrt(Hz)
    accelerometer_walk: float = 1e-3  # m/s^3/sqrt(Hz)
    magnetometer: float = 0.5  # microtesla; standard deviation of a reading


#: A rigid body with the sensors at its centre.
_BODY = f"""
<mujoco>
  <option timestep="{DT / _FINE}" integrator="RK4" gravity="0 0 {-GRAVITY}" magnetic="{" ".join(map(str, FIELD))}"/>
  <worldbody>
    <body>
      <freejoint/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.012 0.015"/>
      <site name="imu"/>
    </body>
  </worldbody>
  <sensor>
    <gyro site="imu"/>
    <accelerometer site="imu"/>
    <magnetometer site="imu"/>
  </sensor>
</mujoco>
"""


def simulated(runs: int, seconds: float, seed: int, sensors: Sensors | None = None) -> TensorDict:
    """Returns simulated logs of a cheap inertial sensor on a free body, pushed and turned at random about a place.

    Gyro and accelerometer read the mean over the time since the last row, the magnetometer an instant.

    Args:
        runs: R.
        seconds: of a run; it has T rows of 0.01 s.
        seed: of motions and sensors.
        sensors: their errors.

    Returns:
        ``[R, T]``: ``"imu"`` (gyro in rad/s, accelerometer in m/s^2; also each by itself), ``"magnetometer"`` in
        microtesla, ``"dt"``; the truth as ``"orientation"``, ``"velocity"`` and ``"position"`` in the world's axes,
        ``"gyro_bias"`` and ``"accelerometer_bias"``.
    """
    sensors = Sensors() if sensors is None else sensors
    random, rows = np.random.default_rng(seed), round(seconds / DT)
    model = mujoco.MjModel.from_xml_string(_BODY)
    found = [_run(model, rows, random) for _ in range(runs)]
    true, poses = (np.stack(parts) for parts in zip(*found, strict=True))
    start = random.standard_normal((runs, 1, 6)) * _six(sensors.gyro_bias, sensors.accelerometer_bias)
    walk = random.standard_normal((runs, rows, 6)) * _six(sensors.gyro_walk, sensors.accelerometer_walk) * DT**0.5
    bias = start + walk.cumsum(1)
    white = random.standard_normal((runs, rows, 6)) * _six(sensors.gyro_noise, sensors.accelerometer_noise) / DT**0.5
    imu = true[..., :6] + bias + white
    magnetometer = true[..., 6:] + sensors.magnetometer * random.standard_normal((runs, rows, 3))
    entries = {"imu": imu, "gyro": imu[..., :3], "accelerometer": imu[..., 3:], "magnetometer": magnetometer}
    entries |= {"orientation": poses[..., 6:], "velocity": poses[..., 3:6], "position": poses[..., :3]}
    entries |= {"gyro_bias": bias[..., :3], "accelerometer_bias": bias[..., 3:], "dt": np.full((runs, rows, 1), DT)}
    return _as_data(entries, runs, rows)


def walking(folder: Path) -> TensorDict:
    """Returns a log of the humanoid iCub, which walks 1.5 m in 12 s, with motion capture as truth.

    Args:
        folder: with ``walking.npz`` and ``model.urdf``.

    Returns:
        ``[1, T]``, in the axes of the robot's root: ``"imu"``, ``"gyro"``, ``"accelerometer"``; ``"dt"``, which varies;
        the truth as ``"orientation"`` and ``"position"``. ``"leg"``: the velocity of the sensor in m/s from joints and
        gyro, if the foot that bears more stands still; ``"leg_observed"``: whether it bears more than 60 N.
    """
    with np.load(folder / "walking.npz") as file:
        log = {key: file[key] for key in file.files}
    joint = ElementTree.parse(folder / "model.urdf").find("joint[@name='root_link_imu_frame_fixed_joint']/origin")
    if joint is None:
        raise ValueError(f"{folder / 'model.urdf'} does not say where the sensor sits: it has no root_link_imu_frame")
    angles = torch.tensor([float(word) for word in joint.attrib["rpy"].split()], dtype=torch.float64)
    to_root = _of_rpy(angles)
    names = {"gyro": "imu_angular_velocity", "accelerometer": "imu_acceleration"}
    entries = {key: rotate(to_root, torch.as_tensor(log[name])).numpy() for key, name in names.items()}
    entries["imu"] = np.concatenate([entries["gyro"], entries["accelerometer"]], -1)
    entries["orientation"] = _of_rpy(torch.as_tensor(log["base_rpy"])).numpy()
    entries["position"] = log["base_position"]
    entries["leg"] = _leg_velocity(folder / "model.urdf", log, entries["gyro"])
    steps = np.diff(log["time"])
    entries["dt"] = np.concatenate([[np.median(steps)], steps])[:, None]
    data = _as_data({key: value[None] for key, value in entries.items()}, 1, len(log["time"]))
    bears = np.maximum(log["left_foot_force_z"], log["right_foot_force_z"]) > _BEARS
    data["leg_observed"] = torch.as_tensor(bears).reshape(1, -1, 1)
    return data


def tilt_error(orientation: Tensor, truth: Tensor) -> Tensor:
    """Returns the angle ``[*]`` in rad between the true and the estimated vertical, from quaternions ``[*, 4]``."""
    up = torch.tensor([0.0, 0.0, 1.0]).to(truth)
    one, other = (rotate(SO3().inverse(each), up) for each in (orientation, truth))
    return torch.atan2(torch.linalg.cross(one, other).norm(dim=-1), (one * other).sum(-1))


def _run(model: mujoco.MjModel, rows: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Returns noise-free readings ``[T, 9]``, and position, velocity and orientation ``[T, 10]``."""
    data = mujoco.MjData(model)
    quaternion = random.standard_normal(4)
    data.qpos[3:] = quaternion / np.linalg.norm(quaternion)
    # Ornstein-Uhlenbeck processes: a force of 1.5 N on 1 kg that lasts .3 s, and turns of .6 rad/s.
    keep, std = math.exp(-DT / _FINE / 0.3), np.array([1.5] * 3 + [0.03] * 3)
    push = std * random.standard_normal(6)
    draws = math.sqrt(1 - keep**2) * std * random.standard_normal((rows, _FINE, 6))
    readings, poses = np.empty((rows, 9)), np.empty((rows, 10))
    for row in range(rows):
        total = np.zeros(9)
        for draw in draws[row]:
            push = keep * push + draw
            back = -1.0 * data.qpos[:3] - 1.0 * data.qvel[:3]
            data.xfrc_applied[1, :3] = push[:3] + back + [0.0, 0.0, GRAVITY]
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, data.qpos[3:7])
            data.xfrc_applied[1, 3:] = turn.reshape(3, 3) @ (push[3:] - 0.03 * data.qvel[3:])
            mujoco.mj_forward(model, data)
            begin = data.sensordata.copy()
            mujoco.mj_step(model, data)
            mujoco.mj_forward(model, data)  # under the same force
            total += 0.5 * (begin + data.sensordata)
        readings[row] = total / _FINE
        readings[row, 6:] = data.sensordata[6:]
        poses[row] = [*data.qpos[:3], *data.qvel[:3], *data.qpos[3:]]
    return readings, poses


def _leg_velocity(urdf: Path, log: dict[str, np.ndarray], gyro: np.ndarray) -> np.ndarray:
    """Returns the velocity ``[T, 3]`` of the inertial sensor from the standing leg, in the axes of the root."""
    tree = ElementTree.parse(urdf)
    for part in list(tree.iter()):
        for child in list(part):
            if child.tag in ("visual", "collision", "gazebo", "sensor"):
                part.remove(child)
    options = {"fusestatic": "false", "balanceinertia": "true", "boundmass": "1e-4", "boundinertia": "1e-6"}
    ElementTree.SubElement(ElementTree.SubElement(tree.getroot(), "mujoco"), "compiler", options)
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(tree.getroot(), encoding="unicode"))
    data = mujoco.MjData(model)
    joints = [model.joint(name).id for name in _JOINTS.split()]
    root, imu, *feet = (model.body(name).id for name in ("root_link", "root_link_imu_frame", "l_sole", "r_sole"))
    left = log["left_foot_force_z"] > log["right_foot_force_z"]
    found, jacobian = np.empty((len(left), 3)), np.empty((3, model.nv))
    for row, (angles, rates) in enumerate(zip(log["joint_positions"], log["joint_velocities"], strict=True)):
        data.qpos[model.jnt_qposadr[joints]] = angles
        mujoco.mj_forward(model, data)
        foot = feet[0 if left[row] else 1]
        mujoco.mj_jacBody(model, data, jacobian, None, foot)
        moves = jacobian[:, model.jnt_dofadr[joints]] @ rates
        to_root = data.xmat[root].reshape(3, 3).T
        found[row] = -to_root @ moves - np.cross(gyro[row], to_root @ (data.xpos[foot] - data.xpos[imu]))
    return found


def _of_rpy(angles: Tensor) -> Tensor:
    """Returns the quaternions of roll, pitch and yaw ``[*, 3]``: rotations about x, then y, then z of the world."""
    turns = [SO3().exp(angles[..., axis : axis + 1] * torch.eye(3).to(angles)[axis]) for axis in range(3)]
    return SO3().compose(turns[2], SO3().compose(turns[1], turns[0]))


def _six(gyro: float, accelerometer: float) -> np.ndarray:
    return np.array([gyro] * 3 + [accelerometer] * 3)


def _as_data(entries: dict[str, np.ndarray], runs: int, rows: int) -> TensorDict:
    return TensorDict(
        {key: torch.as_tensor(value, dtype=torch.float32) for key, value in entries.items()}, [runs, rows]
    )
