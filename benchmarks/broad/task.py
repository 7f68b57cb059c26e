"""The trials of BROAD, their kinds of motion, and the benchmark's errors.

Data: Laidig, Caruso, Cereatti & Seel 2021, Data 6 (7), CC BY 4.0, https://github.com/dlaidig/broad.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torch_denkf.applications.imu.filter import ImuSettings
from torch_denkf.applications.imu.log import imu_rows
from torch_denkf.functional.manifolds import SO3, quaternion_product

__all__ = ["LEVEL", "Trial", "first_orientation", "kind_of", "read_trials", "scores", "simulated_trial"]

LEVEL = 0.9  # nominal coverage of the intervals
_ONE, _TWO = 1.6449, 2.1460  # radii with coverage LEVEL for a standard normal error of one and of two components


@dataclass(frozen=True)
class Trial:
    """One trial.

    Attributes:
        name: of its file.
        kind: of motion or disturbance.
        gyro: ``[T, 3]`` in rad/s.
        acceleration: ``[T, 3]`` in m/s^2.
        magnetometer: ``[T, 3]`` in uT.
        orientation: true quaternion ``[T, 4]``, NaN where the cameras lost the sensor.
        scored: rows in which the sensor moves and the truth is known, ``[T]`` bool.
        rate: sampling rate in Hz.
    """

    name: str
    kind: str
    gyro: Tensor
    acceleration: Tensor
    magnetometer: Tensor
    orientation: Tensor
    scored: Tensor
    rate: float


def kind_of(name: str) -> str:
    """Returns the kind of motion or disturbance in a file's name.

    Example:
        >>> kind_of("05_undisturbed_slow_rotation_with_breaks_B"), kind_of("33_disturbed_attached_magnet_2cm")
        ('slow rotation', 'attached magnet')
    """
    plain = re.sub(r"^\d+_(un)?disturbed_|_with_breaks|_\dcm|_[A-Z]$", "", name)
    return re.sub(r"_[A-Z]$", "", plain).replace("_", " ")


def read_trials(folder: Path) -> list[Trial]:
    """Reads every ``.npz`` of a folder, in the order of names.

    Raises:
        FileNotFoundError: if there is none.
    """
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise FileNotFoundError(f"no .npz in {folder}: give --data the folder with the trials of BROAD")
    return [_trial(file) for file in files]


def _trial(file: Path) -> Trial:
    with np.load(file) as data:
        read = {name: torch.as_tensor(data[name].astype(float)) for name in data.files if name != "rate"}
        rate = float(data["rate"])
    known = read["orientation"].isfinite().all(-1)
    sensors = {name: read[name] for name in ("gyro", "acceleration", "magnetometer", "orientation")}
    return Trial(file.stem, kind_of(file.stem), **sensors, scored=known & (read["moving"] > 0), rate=rate)


def simulated_trial(seconds: float = 10.0, rate: float = 100.0, seed: int = 0) -> Trial:
    """Simulates a sensor that rests for 3 s and then turns and sways; its noise is white, and its gyro has a bias."""
    generator = torch.Generator().manual_seed(seed)
    count = round(seconds * rate)
    time = torch.arange(count, dtype=torch.float64).unsqueeze(-1) / rate
    moves = time >= 3.0
    turn = moves * torch.tensor([0.8, -0.6, 0.9]) * (time * torch.tensor([1.1, 0.7, 0.5])).sin()
    orientation = [SO3().neutral(turn)]
    for step in (turn / rate)[1:]:
        orientation.append(SO3().plus(orientation[-1], step))
    truth = torch.stack(orientation)
    push = moves * torch.tensor([1.0, 0.7, 0.5]) * (time * torch.tensor([5.0, 4.0, 6.0])).sin()
    back = SO3().inverse(truth)

    def noise(size: float) -> Tensor:
        return size * torch.randn(count, 3, generator=generator, dtype=torch.float64)

    def seen(vector: Tensor) -> Tensor:
        pure = torch.cat([torch.zeros_like(vector[:, :1]), vector], -1)
        return quaternion_product(quaternion_product(back, pure), truth)[:, 1:]

    force = seen(push + torch.tensor([0.0, 0.0, 9.82])) + noise(0.05)
    field = seen(torch.tensor([0.0, 16.0, -41.0], dtype=torch.float64).expand(count, 3)) + noise(0.5)
    gyro = turn + noise(0.003) + torch.tensor([0.004, -0.002, 0.003])
    return Trial("simulated", "simulated", gyro, force, field, truth, moves.squeeze(-1), rate)


def first_orientation(trial: Trial) -> Tensor:
    """Returns the initial orientation ``[4]`` from the first readings of accelerometer and magnetometer."""
    readings = (each[:100] for each in (trial.gyro, trial.acceleration, trial.magnetometer))
    return imu_rows(ImuSettings(), *readings, rate=trial.rate)["start"][0, :4]


def scores(trial: Trial, quaternion: Tensor, std: Tensor | None = None) -> dict[str, float]:
    """Returns the benchmark's errors in degrees, and the coverage of the 90 % intervals.

    With e the estimate times the inverse of the truth: total 2 acos |e_w|, heading 2 atan (e_z / e_w), inclination
    2 acos sqrt(e_w^2 + e_z^2). Each is the root mean square over the scored rows.

    Args:
        trial: with the truth.
        quaternion: estimate ``[T, 4]``.
        std: standard deviations about the world's axes ``[T, 3]`` in rad; ``None`` gives no coverage.
    """
    rows = trial.scored
    truth = SO3().normalise(trial.orientation[rows])
    w, x, y, z = quaternion_product(quaternion[rows].double(), SO3().inverse(truth)).unbind(-1)
    total = 2 * w.abs().clamp_max(1).acos()
    heading = 2 * (z / w).atan()
    inclination = 2 * (w.square() + z.square()).sqrt().clamp_max(1).acos()
    errors = {"total": total, "heading": heading, "inclination": inclination}
    found = {name: each.square().mean().sqrt().rad2deg().item() for name, each in errors.items()}
    if std is not None:
        std = std[rows].double()
        tilt = 2 * torch.stack([x, y], -1) * w.sign().unsqueeze(-1) / std[:, :2]
        found["heading_held"] = (heading.abs() < _ONE * std[:, 2]).double().mean().item()
        found["inclination_held"] = (tilt.norm(dim=-1) < _TWO).double().mean().item()
        found["heading_std"] = std[:, 2].square().mean().sqrt().rad2deg().item()
    return found
