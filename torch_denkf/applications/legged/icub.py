"""iCub walks: its model without meshes, and a log with motion capture as truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.applications.legged.contacts import contacts
from torch_denkf.functional.manifolds import SO3, rotate

__all__ = ["ICUB", "icub_log", "icub_model"]

_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow")
_LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
_JOINTS = (
    *(
        f"{part}_{way}"
        for part, ways in (("neck", "pitch roll yaw"), ("torso", "pitch roll yaw"))
        for way in ways.split()
    ),
    *(f"{side}_{name}" for names in (_ARM, _LEG) for side in "lr" for name in names),
)
#: Names of its feet, sensor and joints, as :func:`~torch_denkf.applications.legged.legged_filter` takes them.
ICUB: dict[str, Any] = {"feet": ["l_sole", "r_sole"], "imu": "root_link_imu_frame", "joints": list(_JOINTS)}
_ON, _OFF = 60.0, 40.0  # N, of the force under a foot; iCub weighs 330 N


def icub_model(folder: Path) -> mujoco.MjModel:
    """Loads the robot's kinematic model, without meshes, from ``model.urdf`` in a folder."""
    robot = ElementTree.parse(folder / "model.urdf").getroot()
    for parent in (robot, *robot.findall("link")):
        for child in list(parent):
            if child.tag in ("visual", "collision", "gazebo", "sensor"):
                parent.remove(child)
    options = {"fusestatic": "false", "balanceinertia": "true", "boundmass": "0.0001", "boundinertia": "0.000001"}
    ElementTree.SubElement(ElementTree.SubElement(robot, "mujoco"), "compiler", options)
    return mujoco.MjModel.from_xml_string(ElementTree.tostring(robot, encoding="unicode"))


def icub_log(folder: Path) -> TensorDict:
    """Returns a walk of 1.5 m in 12 s at 99 Hz, with motion capture as truth.

    Args:
        folder: with ``walking.npz``.

    Returns:
        ``[1, T]`` in double precision. Readings: ``"imu"`` (gyro in rad/s, accelerometer in m/s^2, in the sensor's
        axes, each the mean of this row's and the last one's), ``"dt"`` in s, ``"joints"`` and ``"joint_rates"`` in the
        order of ``ICUB["joints"]``, ``"force"`` under the feet in N and ``"contact"``. Truth, of the base:
        ``("true", "orientation")``, ``("true", "position")``, ``("true", "velocity")`` in its own axes, which is
        differentiated over 21 rows, and ``("true", "feet")`` in the world.
    """
    with np.load(folder / "walking.npz") as file:
        log = {key: torch.as_tensor(file[key]) for key in file.files}
    steps = log["time"].diff()
    dt = torch.cat([steps.median().unsqueeze(0), steps]).unsqueeze(-1)
    imu = torch.cat([log["imu_angular_velocity"], log["imu_acceleration"]], -1)
    imu[1:] = (imu[1:] + imu[:-1]) / 2
    force = torch.stack([log["left_foot_force_z"], log["right_foot_force_z"]], -1)
    orientation = of_rpy(log["base_rpy"])
    true = {"orientation": orientation, "position": log["base_position"]}
    velocity = savitzky_golay(log["base_position"], log["time"])
    true["velocity"] = rotate(orientation, velocity, back=True)
    true["feet"] = torch.stack([log["left_foot_position"], log["right_foot_position"]], -2)
    entries = {"imu": imu, "dt": dt, "joints": log["joint_positions"], "joint_rates": log["joint_velocities"]}
    entries |= {"force": force, "contact": contacts(force, _ON, _OFF), "true": TensorDict(true, [len(dt)])}
    return TensorDict(entries, [len(dt)]).unsqueeze(0)


def savitzky_golay(values: torch.Tensor, time: torch.Tensor, rows: int = 21, order: int = 3) -> torch.Tensor:
    """Returns derivatives ``[T, N]`` of values by local polynomials; they are constant at the ends."""
    half = rows // 2
    at = torch.arange(len(time)).clamp(half, len(time) - 1 - half)
    window = at.unsqueeze(-1) + torch.arange(-half, half + 1)
    away = time[window] - time.unsqueeze(-1)
    powers = away.unsqueeze(-1) ** torch.arange(order + 1)
    return (torch.linalg.pinv(powers) @ values[window])[:, 1]


def of_rpy(rpy: torch.Tensor) -> torch.Tensor:
    """Returns the quaternions of roll, pitch and yaw ``[*, 3]``, turns about x, then y, then z of the world."""
    turns = [SO3().exp(rpy[..., axis : axis + 1] * torch.eye(3).to(rpy)[axis]) for axis in range(3)]
    return SO3().compose(turns[2], SO3().compose(turns[1], turns[0]))
