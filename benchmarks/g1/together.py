"""Fuses camera, encoders and commands of the arm, with coloured noise: ``python -m benchmarks.g1.together``.

All filters read the same camera sensor. Their motion is learned from true states, all noise is estimated from
residuals: no filter is trained.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence
from tyro.conf import OmitArgPrefixes

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.arm import JOINTS
from benchmarks.common.arm.motion import train_motion, with_rates
from benchmarks.common.arm.readings import fail, read_all
from benchmarks.common.tables import head, line, write_page
from benchmarks.g1.base import SensorBudget, TrainedSensor
from benchmarks.g1.motion import AHEAD, Motion
from benchmarks.g1.recordings import Recordings
from torch_denkf import FusedFilter, FusedSensor
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import ConstantNoise, LearnedTransition, MappedNoise, MomentPrior, Select
from torch_denkf.training import hold_last

RATE = 30  # rows per second
ENCODER = math.radians(0.1)  # standard deviation of an encoder's reading, rad
COMMANDS = 8  # number of last commands in the regression of the joints
SURPRISE = 2.0  # factor on the motion's residuals, chosen from 1, 1.5, 2 and 3 on the validation episodes
LEVEL = 1.645  # standard deviations of a 90 % interval
SEEN, AFTER = 30, (30, 90, 300)  # rows with the camera; rows after it is off
Estimate = tuple[Tensor, Tensor | None]  # means and standard deviations of the joints, [N, T, 7]


@dataclass(frozen=True)
class Together(Recordings):
    """Fuses camera, encoders and commands of the arm."""

    seed: int = 0
    page: Path | None = None  # file of the tables
    motion_updates: int = 1500
    sensor_budget: OmitArgPrefixes[SensorBudget] = field(default_factory=lambda: SensorBudget(1800, networks=1))


class Arm:
    """The arm's readings, motion and error models.

    Args:
        study: options with the recordings.
    """

    def __init__(self, study: Together):
        self.study, self.sensor = study, TrainedSensor(study, study.seed, study.sensor_budget)
        self.known = self.sensor.sequences()  # of the training and tuning episodes
        self.begin = torch.stack([state[0] for state, _ in self.known])

    def readings(self, role: str) -> TensorDict:
        """Returns readings of a role's episodes ``[N, T]``: camera, encoders once a second, and commands."""
        read = read_all(self.sensor.trained[0], self.sensor.codes(role), 64)
        out, state = read.select("valid", "arrived", "observed", "state"), read["state"]
        out["camera"], out["camera_observed"] = read["sensor", "ensemble"][..., :JOINTS].mean(-2), read["observed"]
        out["regression"] = torch.stack([lagged(one) @ self.follow for one in read["commands"]])
        out["regression_observed"] = read["valid"]
        noise = torch.randn(state.shape, generator=torch.Generator().manual_seed(0))
        out["encoder"], due = state + ENCODER * noise, torch.arange(state.shape[1]) % RATE == 0
        return out.set("encoder_observed", due.unsqueeze(-1) & read["valid"])

    @cached_property
    def follow(self) -> Tensor:
        """Returns the least-squares weights of the joints on the last commands, ``[8 * 7 + 1, 7]``."""
        inputs, states = torch.cat([lagged(command) for _, command in self.known]), [state for state, _ in self.known]
        return torch.linalg.lstsq(inputs.double(), torch.cat(states).double()).solution.float()

    @cached_property
    def motion(self) -> Motion:
        """Returns the motion, learned from true states."""
        torch.manual_seed(self.study.seed)
        motion, paths = Motion(self.sensor.trained[1]), [with_rates(state, 1) for state, _ in self.known]
        settings = {"seed": self.study.seed, "updates": self.study.motion_updates}
        return train_motion(motion, paths, AHEAD, out=self.study.out / "motions" / "together", **settings)

    @cached_property
    def noise(self) -> MappedNoise:
        """Returns the process noise per row: of the rates, and through them of the joints."""
        motion, pairs = self.motion, [with_rates(state, 1) for state, _ in self.known]
        with torch.no_grad():
            missed = torch.cat([one[1:, JOINTS:] - motion(one[:-1])[:, JOINTS:] for one in pairs])
        root = SURPRISE * torch.linalg.cholesky(missed.mT @ missed / len(missed))
        unit = ConstantNoise([1.0] * JOINTS, in_key=("belief", "mean"), out_key=("forecast", "noise"))
        return MappedNoise(unit, torch.cat([root, root]))

    def start(self, begins: bool = True) -> MomentPrior:
        """Returns the prior at the beginning of an episode, with small rates, or at any time."""
        poses = self.begin if begins else torch.cat([state for state, _ in self.known])
        rate = self.motion.rate.square().diag() * (0.1 if begins else 1.0)
        mean = torch.cat([poses.mean(0), torch.zeros(JOINTS)])
        return MomentPrior(mean, torch.block_diag(poses.mT.cov(), rate))

    @cached_property
    def unseen(self) -> list[TensorDict]:
        """Returns readings of the tuning and validation episodes, which the camera's sensor was not trained on."""
        return [self.readings(role) for role in ("tune", "validation")]

    def errors(self, name: str, kind: str) -> tuple[FadingBias | None, Tensor]:
        """Estimates a sensor's bias and its white noise; ``"episodes"`` adds a bias that is constant in an episode."""
        errors = [torch.where(one[f"{name}_observed"], one[name] - one["state"], torch.nan) for one in self.unseen]
        every = pad_sequence([error for one in errors for error in one], batch_first=True, padding_value=torch.nan)
        if kind == "white":
            return None, every.square().nanmean((0, 1)).sqrt()
        return FadingBias.from_residuals(every, per_run=kind == "episodes", trainable=False)

    def run(self, *names: str, data: TensorDict, begins: bool = True, kind: str = "episodes") -> Estimate:
        """Runs a filter of some sensors; for the kind see :meth:`errors`. Encoders have no bias."""
        sensors, read = {}, Select(list(range(JOINTS)))
        for name in names:
            error, noise = (None, [ENCODER] * JOINTS) if name == "encoder" else self.errors(name, kind)
            sensors[name] = FusedSensor(read, noise, sensor_error=error)
        motion = LearnedTransition(self.motion, residual=False)
        filter = FusedFilter(motion, sensors, initial=self.start(begins), process_noise=self.noise)
        with torch.no_grad():
            belief = filter.sequence(data.exclude("state", "valid", "arrived", "observed").copy())["belief"]
        return belief["mean"][..., :JOINTS], belief["var"][..., :JOINTS].sqrt()

    def held(self, data: TensorDict, name: str) -> Tensor:
        """Returns a sensor's last reading at each row."""
        return hold_last(data[name], data[f"{name}_observed"], self.begin.mean(0).expand_as(data[name][:, 0]))

    def combined(self, data: TensorDict) -> Tensor:
        """Returns the best linear combination of camera, encoder, and the camera at the encoder's time, by joint.

        Its weights are least squares on other episodes.
        """

        def both(one: TensorDict) -> Tensor:
            camera, encoder = (self.held(one, name) for name in ("camera", "encoder"))
            then = hold_last(camera, one["encoder_observed"], camera[:, 0])
            return torch.stack([camera, encoder, then, torch.ones_like(camera)], -1)

        inputs = torch.cat([both(one)[one["valid"].squeeze(-1)] for one in self.unseen])
        wanted = torch.cat([one["state"][one["valid"].squeeze(-1)] for one in self.unseen])
        weights = torch.linalg.lstsq(inputs.transpose(0, 1), wanted.mT.unsqueeze(-1)).solution.squeeze(-1)  # [7, 4]
        return (both(data) * weights).sum(-1)


def lagged(commands: Tensor) -> Tensor:
    """Concatenates the last 8 commands of ``[T, 7]`` and a one to ``[T, 57]``."""
    rows = torch.arange(len(commands))
    parts = [commands[(rows - lag).clamp_min(0)] for lag in range(COMMANDS)]
    return torch.cat([*parts, torch.ones(len(commands), 1)], -1)


def score(estimate: Estimate, data: TensorDict, at: Tensor) -> list[str]:
    """Returns the mean absolute error in degrees, and the coverage of the 90 % intervals, at rows ``[N, T]``."""
    mean, std = estimate
    error = (mean - data["state"])[at].abs()
    held = "" if std is None else f"{100 * (error < LEVEL * std[at]).float().mean():.0f} %"
    return [f"{error.mean().rad2deg():.2f}", held]


def read_together(arm: Arm) -> list[str]:
    """Returns the table of errors and coverages for each set of sensors."""
    data = arm.readings("test")
    at, dark = data["valid"].squeeze(-1).clone(), data.copy()
    at[:, 0] = False
    dark["camera_observed"] = fail(data, "black20")["observed"]
    black = (fail(data, "black20")["arrived"] != data["arrived"]).squeeze(-1)
    both, last = "camera, encoders, 1 Hz", f"last {COMMANDS} commands"
    cases: list[tuple[str, str, Callable[[TensorDict], Estimate]]] = [
        ("camera", "last reading", lambda some: (arm.held(some, "camera"), None)),
        ("camera", "filter", lambda some: arm.run("camera", data=some)),
        ("encoders, 1 Hz", "last reading", lambda some: (arm.held(some, "encoder"), None)),
        ("encoders, 1 Hz", "filter", lambda some: arm.run("encoder", data=some)),
        (both, "best linear combination", lambda some: (arm.combined(some), None)),
        (both, "filter, errors white", lambda some: arm.run("camera", "encoder", data=some, kind="white")),
        (both, "filter, errors of one time", lambda some: arm.run("camera", "encoder", data=some, kind="one")),
        (both, "filter", lambda some: arm.run("camera", "encoder", data=some)),
        (last, "least squares", lambda some: (some["regression"], None)),
        (last, "filter", lambda some: arm.run("regression", data=some)),
        (f"{last}, camera", "filter", lambda some: arm.run("regression", "camera", data=some)),
    ]
    lines = head("read", "by", "error, degrees", "within 90 %", "while 20 frames are black", "within 90 %")
    for read, by, estimate in cases:
        blind = score(estimate(dark), data, black) if "camera" in read else ["", ""]
        lines.append(line(read, by, *score(estimate(data), data, at), *blind))
        print(lines[-1], flush=True)
    return lines


def camera_off(arm: Arm) -> list[str]:
    """Returns the table of errors after the camera is off."""
    data, rows = arm.readings("test"), SEEN + max(AFTER) + 1
    generator, parts = torch.Generator().manual_seed(5), []
    lengths = data["valid"].sum((1, 2)).tolist()
    long = [number for number, length in enumerate(lengths) if length > rows]
    for _ in range(40):
        one = long[int(torch.randint(len(long), (), generator=generator))]
        begin = int(torch.randint(lengths[one] - rows, (), generator=generator))
        parts.append(data[one, begin : begin + rows])
    windows = torch.stack(parts)
    windows["camera_observed"] = windows["camera_observed"] & (torch.arange(rows) < SEEN).view(1, -1, 1)
    beliefs: dict[str, Estimate] = {
        "mean pose": (arm.start(False).mean[:JOINTS].expand_as(windows["state"]), None),
        "last reading": (arm.held(windows, "camera"), None),
        "filter": arm.run("camera", data=windows, begins=False),
    }
    lines = head("belief", *(f"{after / RATE:.0f} s after the last reading" for after in AFTER))
    for name, estimate in beliefs.items():
        at = [(torch.arange(rows) == SEEN - 1 + after).expand(windows.shape) for after in AFTER]
        lines.append(line(name, *(", ".join(filter(None, score(estimate, windows, one))) for one in at)))
    return lines


def main() -> None:
    """Writes the tables."""
    study = parse(Together)
    arm, lines = Arm(study), []
    for title, table in {"What is read": read_together, "A camera that is off": camera_off}.items():
        lines += [f"**{title}**", "", *table(arm), ""]
    write_page("\n".join([*lines, *made_by("g1.together"), ""]), study.page)


if __name__ == "__main__":
    main()
