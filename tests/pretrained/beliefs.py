"""Means and variances of each pretrained filter after six steps of the same random readings."""

import json
from pathlib import Path

import torch
from tensordict import TensorDict

import torch_denkf
from torch_denkf.applications.car.vision.shapes import FLOW_SHAPE, ROAD_SHAPE

_LEGS = {"imu": 6, "joints": 16, "joint_rates": 16, "contact": 4}
_IMU = dict.fromkeys(("gyro", "accelerometer", "magnetometer"), 3) | dict.fromkeys(("unrest", "disturbance", "dt"), 1)
_IMU |= {"moves": 9, "lever": 9, "start": 37}
_READINGS = {
    "car-odometry": {"flow": FLOW_SHAPE, "road": ROAD_SHAPE, "start": (5,)},
    "imu": {key: (size,) for key, size in _IMU.items()},
    "quadruped": {key: (size,) for key, size in _LEGS.items()}
    | {("last", key): (10 * size,) for key, size in _LEGS.items()},
    "reacher": {"encoder": (2,), "action": (2,)},
    "ur5-table": {"pixels": (3, 64, 64), "action": (7,)},
}


def all_beliefs():
    """Returns the last mean and variance of each filter, by name."""
    out = {}
    for name in torch_denkf.available():
        generator = torch.Generator().manual_seed(0)
        data = {key: torch.rand(6, *shape, generator=generator) for key, shape in _READINGS[name].items()}
        data.update({key: each > 0.5 for key, each in data.items() if "contact" in key})
        if name == "imu":
            data["start"][:, :4] = torch.tensor([1.0, 0.0, 0.0, 0.0])
        torch.manual_seed(0)
        with torch.no_grad():
            belief = torch_denkf.from_pretrained(name).sequence(TensorDict(data, [6]))["belief"][-1]
        out[name] = [*belief["mean"].tolist(), *belief["var"].tolist()]
    return out


if __name__ == "__main__":
    print(json.dumps({"package": str(Path(torch_denkf.__file__).parent), **all_beliefs()}))
