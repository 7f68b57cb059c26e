"""A UR5 at its table: a camera at 12.5 Hz, noisy encoders at 100 Hz, and a drifting force sensor in the gripper."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.fusion.task import Task, add_features, fused_sensors
from torch_denkf.applications.ur5 import UR5TableEnv
from torch_denkf.applications.ur5.envs.expert import UR5Expert
from torch_denkf.functional import crps_gaussian
from torch_denkf.fusion import FusedFilter
from torch_denkf.modules import ConstantNoise, LinearObservation, LinearTransition, MappedNoise, MomentPrior
from torch_denkf.pretrained import from_pretrained

JOINTS, EVERY, DT = 7, 8, 0.01  # six joints and the gripper's opening; encoder steps in a step of the environment; s
ENCODER = math.radians(2.0)  # rad, white
STIFFNESS, FORCE, DRIFT = 10.0, 0.2, 0.5  # N/rad; N, white; N for each root of a second
STATE = 2 * JOINTS + 1  # angles rad, their rates rad/s, the force sensor's drift in rad of opening
TASKS = ("pick", "push", "put_down")


@torch.no_grad()
def record(demos: int, steps: int, seed: int) -> TensorDict:
    """Returns demonstrations at 100 Hz, ``[demos, 8 steps]``: truth, and readings of encoders, force and camera."""
    sensor, rows = from_pretrained("ur5-table")["sensor"], []
    for number in range(demos):
        env = UR5TableEnv(TASKS[number % 3], size=(64, 64), seed=seed + number, max_steps=steps)
        torch.manual_seed(seed + number)
        rollout = env.rollout(steps, UR5Expert(env))
        env.close(raise_if_closed=False)
        camera = torch.cat([sensor(part.select("pixels"))["sensor", "ensemble"].mean(-2) for part in rollout.split(50)])
        angles, targets = rollout["state"][:, :JOINTS], rollout["action"][:, JOINTS - 1 :]
        rows.append(TensorDict({"angles": angles, "camera": camera[:, :JOINTS], "target": targets}, [steps]))
    data = torch.stack(rows)
    generator = torch.Generator().manual_seed(seed)
    angles = finer(data["angles"])
    rates = torch.diff(angles, dim=1, append=angles[:, -1:]) / DT
    size = angles.shape[:2]

    def normal(*shape):
        return torch.randn(*size, *shape, generator=generator)

    drift = (DRIFT * math.sqrt(DT) * normal(1)).cumsum(1) / STIFFNESS
    out = TensorDict({"state": torch.cat([angles, rates, drift], -1)}, size)
    out["encoders"] = angles[..., :6] + ENCODER * normal(6)
    # The force is that of a spring between the opening and its target, which is known: it reads the opening.
    out["force"] = angles[..., 6:] + drift + FORCE / STIFFNESS * normal(1)
    out["camera"] = data["camera"].repeat_interleave(EVERY, 1)
    seen = torch.ones(*size, 1, dtype=torch.bool)
    out["encoders_observed"], out["force_observed"] = seen, seen.clone()
    for name in ("camera", "encoders", "force"):
        out[f"{name}_late"] = torch.zeros(*size, 1, dtype=torch.int64)
    out["camera_observed"] = (torch.arange(size[1]) % EVERY == 0).reshape(1, -1, 1).expand(size[0], -1, 1).clone()
    return out


def finer(angles: Tensor) -> Tensor:
    """Interpolates angles ``[N, T, 7]`` at 12.5 Hz to 100 Hz, ``[N, 8 T, 7]`` (cubic Hermite)."""
    slope = torch.gradient(angles, dim=1)[0]
    end, end_slope = (torch.cat([value[:, 1:], value[:, -1:]], 1) for value in (angles, slope))
    t = (torch.arange(EVERY) / EVERY).reshape(1, 1, EVERY, 1)
    begin, begin_slope, end, end_slope = (value.unsqueeze(2) for value in (angles, slope, end, end_slope))
    path = (2 * t**3 - 3 * t**2 + 1) * begin + (t**3 - 2 * t**2 + t) * begin_slope
    path = path + (3 * t**2 - 2 * t**3) * end + (t**3 - t**2) * end_slope
    return path.flatten(1, 2)


def arm_task(*, demos: tuple[int, int] = (24, 6), steps: int = 75, validate: bool = False) -> Task:
    """Returns the task.

    Args:
        demos: for training, and for the test.
        steps: of the environment in each, 0.08 s.
        validate: whether to score validation recordings instead of the test's.
    """
    names = ("camera", "encoders", "force")
    train, test = record(demos[0], steps, 10_000), record(demos[1], steps, 30_000 if validate else 20_000)
    angles, eye = train["state"][..., :JOINTS], torch.eye(STATE)
    camera = (train["camera"] - angles).square().mean((0, 1)).sqrt()
    noises = {"camera": camera, "encoders": torch.full((6,), ENCODER), "force": torch.tensor([FORCE / STIFFNESS])}
    train, test = (add_features(data, noises) for data in (train, test))
    move = eye.clone()
    move[:JOINTS, JOINTS:-1] = DT * torch.eye(JOINTS)
    # The random walk of the rates, from their change over a step of the environment.
    rates = train["state"][..., JOINTS:-1]
    walk = (rates[:, EVERY:] - rates[:, :-EVERY]).square().mean((0, 1)).div(EVERY).sqrt()
    push = torch.cat([walk, torch.tensor([DRIFT * math.sqrt(DT) / STIFFNESS])])
    mean, start = train["state"].mean((0, 1)), train["state"].std((0, 1)).square().diag()
    force = torch.zeros(1, STATE)
    force[0, 6] = force[0, -1] = 1.0
    readings = {"camera": eye[:JOINTS], "encoders": eye[:6], "force": force}
    late = dict.fromkeys(names, EVERY)
    parts = {name: ConstantNoise(noises[name], trainable=True, in_key=name) for name in names}
    parts["motion"] = ConstantNoise(push, trainable=True, in_key=("belief", "mean"), out_key=("forecast", "noise"))

    def build(weights: nn.Module | None, heed: bool) -> FusedFilter:
        models = {name: LinearObservation(matrix) for name, matrix in readings.items()}
        sensors = fused_sensors(models, parts, late, weights is not None, heed)
        motion = LinearTransition(move, MappedNoise(parts["motion"], eye[:, JOINTS:]))
        # Linear sensors: one update of all is the same as one after the other, and takes less time.
        return FusedFilter(motion, sensors, initial=MomentPrior(mean, start), joint=True, weights=weights)

    def loss(out: TensorDict) -> Tensor:
        mean, var, truth = (
            value[..., :JOINTS] for value in (out["belief", "mean"], out["belief", "var"], out["state"])
        )
        return crps_gaussian(mean, var, truth).mean() / 0.02

    def error(out: TensorDict) -> Tensor:
        return (out["belief", "mean"] - out["state"])[..., :6].rad2deg()

    offsets = {"camera": torch.full((7,), 0.4), "encoders": torch.full((6,), 0.2), "force": torch.tensor([0.3])}
    modules = nn.ModuleDict(parts)
    training = ((*names, "encoders"), 0.0, (15, 70))
    return Task("UR5", 1 / DT, offsets, noises, *training, late, train, test, modules, build, False, loss, error, "deg")
