"""A car on KITTI's roads: a camera at 10 Hz, a wheel odometer at 50 Hz, and a GPS at 1 Hz that is 0.3 s late."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.fusion.task import Task, add_features, delayed, fused_sensors
from torch_denkf.applications.car import UnicycleTransition
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.files import read_poses
from torch_denkf.applications.car.modules.unicycle_noise import UnicycleNoise
from torch_denkf.applications.car.odometry.filter import VELOCITIES
from torch_denkf.applications.car.odometry.streams import Drive, read_sensor
from torch_denkf.applications.car.unicycle import unicycle_move
from torch_denkf.applications.car.vision.poses import KITTI_DT, poses_to_state
from torch_denkf.functional import crps_gaussian
from torch_denkf.fusion import FusedFilter
from torch_denkf.modules import ConstantNoise, GaussianAround, Select
from torch_denkf.pretrained import from_pretrained

FINER = 5  # filter steps between two frames
DT, FIX, LATE = KITTI_DT / FINER, 48, 15  # s; steps between two fixes of the GPS, and by which they are late
CAMERA = torch.tensor([0.6, 0.02])  # m/s and rad/s, noise of the camera's readings in training
GAIN, SLIP = 0.05, 0.02  # scale errors of the camera and of the wheels, drawn for each drive
WHEELS, GPS = torch.tensor([0.3, 0.03]), torch.tensor([1.5, 1.5])  # m/s and rad/s; m
MIDDLE = 2  # latency of a reading, which belongs to the time midway between two frames, in steps
START = torch.tensor([0.5, 0.5, 0.02, 1.0, 0.05])  # m, m, rad, m/s, rad/s: standard deviations of the initial state
TRAIN, VALIDATION = ("02", "05", "08", "09", "10"), ("03", "04", "07")  # paths without images


def readings(states: Tensor, camera: Tensor, seed: int) -> TensorDict:
    """Returns all readings of drives at 50 Hz.

    Args:
        states: truth at 10 Hz, ``[N, T, 5]``: the velocities are those of the step before.
        camera: its readings of the velocities, ``[N, T, 2]``.
        seed: of the simulated sensors.
    """
    generator = torch.Generator().manual_seed(seed)
    velocity, pose, steps = states[:, 1:, 3:], states[:, :-1, :3], []
    for _ in range(FINER):
        pose = unicycle_move(pose, velocity, DT)
        steps.append(torch.cat([pose, velocity], -1))
    state = torch.stack(steps, 2).flatten(1, 2)
    size = state.shape[:2]

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    out = TensorDict({"state": state}, size)
    gain = 1 + SLIP * normal(size[0], 1, 1)
    out["wheels"] = gain * state[..., 3:] + WHEELS * normal(*size, 2)
    out["gps"] = state[..., :2] + GPS * normal(*size, 2)
    out["camera"] = camera[:, 1:].repeat_interleave(FINER, 1)
    time = torch.arange(size[1])
    masks = {"camera": time % FINER == FINER - 1, "wheels": time >= 0, "gps": time % FIX == 0}
    for name, mask in masks.items():
        out[f"{name}_late"] = torch.full((*size, 1), MIDDLE if name == "camera" else 0)
        out[f"{name}_observed"] = mask.reshape(1, -1, 1).expand(*size, 1).clone()
    out["start"] = state + START * normal(*size, 5)  # a window begins anywhere
    return add_features(out, {"camera": CAMERA, "wheels": WHEELS, "gps": GPS})


@torch.no_grad()
def recorded(root: Path, frames: int) -> tuple[Tensor, Tensor]:
    """Returns windows of real drives ``[N, frames, ...]``: true states, and readings of the shipped sensor."""
    car, parts = from_pretrained("car-odometry"), []
    for name in list_kitti_drives(root):
        data = Drive(root, name, car.settings.size, True).read()
        read = read_sensor(car.sensor, data, 1)
        rows = torch.cat([data["state"], read["sensor", "ensemble"].mean(-2)], -1)
        valid = read["observed"].squeeze(-1)
        for window in range(len(rows) // frames):
            part = slice(window * frames, (window + 1) * frames)
            if valid[part][1:].all():
                parts.append(rows[part])
    rows = torch.stack(parts).float()
    return rows[..., :5], rows[..., 5:]


def driven(root: Path, names: Sequence[str], frames: int, seed: int) -> tuple[Tensor, Tensor]:
    """Returns windows of true paths, and simulated readings of a camera."""
    parts = []
    for name in names:
        poses = read_poses(root / "poses" / f"{name}.txt")
        state = torch.from_numpy(poses_to_state(poses, torch.full((len(poses) - 1,), KITTI_DT).numpy())).float()
        parts += [part for part in state.split(frames) if len(part) == frames][:40]
    states, generator = torch.stack(parts), torch.Generator().manual_seed(seed)
    gain = 1 + GAIN * torch.randn(len(states), 1, 1, generator=generator)
    noise = CAMERA * torch.randn(*states.shape[:2], 2, generator=generator)
    return states, gain * states[..., VELOCITIES] + noise


def simulated(frames: int, seed: int, count: int = 2) -> tuple[Tensor, Tensor]:
    """Returns windows of a synthetic drive, for a run without data."""
    generator = torch.Generator().manual_seed(seed)
    velocity = torch.tensor([10.0, 0.0]) + torch.randn(count, frames, 2, generator=generator) * torch.tensor([1.0, 0.1])
    pose, states = torch.zeros(count, 3), []
    for step in velocity.unbind(1):
        pose = unicycle_move(pose, step, KITTI_DT)
        states.append(torch.cat([pose, step], -1))
    return torch.stack(states, 1), velocity + CAMERA * torch.randn(count, frames, 2, generator=generator)


def car_task(root: Path | None, *, frames: int = 60, validate: bool = False) -> Task:
    """Returns the task, on real frames, or on a synthetic drive without data.

    Args:
        root: folder with ``sequences`` and ``poses``.
        frames: of each recording, 0.103 s apart.
        validate: whether to score validation paths with a simulated camera instead of the test's drives.
    """
    train = readings(*(simulated(frames, 1) if root is None else driven(root, TRAIN, frames, 1)), 1)
    if root is None:
        paths = simulated(frames, 2)
    else:
        paths = driven(root, VALIDATION, frames, 3) if validate else recorded(root, frames)
    test = delayed(readings(*paths, 2), "gps", LATE)
    noises = {"camera": CAMERA, "wheels": WHEELS, "gps": GPS}
    models = {"camera": Select(VELOCITIES), "wheels": Select(VELOCITIES), "gps": Select([0, 1])}
    late = {"camera": FINER, "wheels": FINER, "gps": 0}  # in addition to their usual latency
    longest = {"camera": MIDDLE + FINER, "wheels": FINER, "gps": LATE}
    parts = {name: ConstantNoise(noises[name], trainable=True, in_key=name) for name in models}
    walk = {"in_key": ("belief", "mean"), "out_key": ("forecast", "noise")}
    parts["motion"] = ConstantNoise([0.3, 0.06], trainable=True, **walk)

    def build(weights: nn.Module | None, heed: bool) -> FusedFilter:
        return FusedFilter(
            UnicycleTransition(torch.zeros_like, DT),
            fused_sensors(models, parts, longest, weights is not None, heed),
            initial=GaussianAround(START, state_key="start"),
            process_noise=UnicycleNoise(parts["motion"], DT),
            joint=True,  # linear sensors: the same as one after the other, in less time
            weights=weights,
        )

    def loss(out: TensorDict) -> Tensor:
        score = crps_gaussian(out["belief", "mean"], out["belief", "var"], out["state"])
        return (score[..., [0, 1, 3, 4]] / torch.tensor([0.5, 0.5, 0.3, 0.03])).mean()

    def error(out: TensorDict) -> Tensor:
        return (out["belief", "mean"] - out["state"])[..., :2]

    wrong = torch.tensor([-6.0, 0.2])
    offsets = {"camera": wrong, "wheels": wrong, "gps": torch.tensor([15.0, 15.0])}
    modules = nn.ModuleDict(parts)
    training = (("camera", "wheels", "wheels", "gps"), 3.0, (15, 40))
    return Task("KITTI", 1 / DT, offsets, noises, *training, late, train, test, modules, build, True, loss, error, "m")
