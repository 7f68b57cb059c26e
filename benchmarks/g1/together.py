"""Camera, encoders and commands of the arm together, each with errors that last: ``python -m benchmarks.g1.together``.

All filters run on what one camera sensor reads. Their motion is learned from true states, all else is taken from
residuals: no filter is trained.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence
from tyro.conf import OmitArgPrefixes

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.g1.base import SensorBudget, TrainedSensor
from benchmarks.g1.motion import Motion, train_motion, with_rates
from benchmarks.g1.readings import blackouts, read_codes
from benchmarks.g1.recordings import ARM as JOINTS
from benchmarks.g1.recordings import Recordings, rows_of
from benchmarks.g1.sensors import read_code
from torch_denkf import FusedFilter, FusedSensor
from torch_denkf.imperfect import FadingBias
from torch_denkf.modules import ConstantNoise, LearnedTransition, MappedNoise, MomentPrior, Select
from torch_denkf.training import hold_last

SIZE, RATE = len(JOINTS), 30  # joints; rows a second
ENCODER = math.radians(0.1)  # standard deviation of an encoder's reading, rad
COMMANDS = 8  # of the last rows, that the joints follow
SAMPLES = 64  # of the camera's sensor
SURPRISES, SURPRISE = (1.0, 1.5, 2.0, 3.0), 2.0  # factors on what the motion missed in training; the chosen one
LEVEL = 1.645  # standard deviations of a 90 % interval
READ, AFTER = 30, (30, 90, 300)  # rows that are read before the camera is off; rows without it
OFFSET = math.radians(5.0)  # standard deviation of an encoder's offset
EPISODES, DRAWS = (1, 5, 10), 60  # after which the offset is scored; orders of the episodes


@dataclass(frozen=True)
class Together(Recordings):
    """Camera, encoders and commands of the arm together."""

    seed: int = 0
    page: Path | None = None  # file of the tables
    motion_updates: int = 1500
    sensor_budget: OmitArgPrefixes[SensorBudget] = field(default_factory=lambda: SensorBudget(1800, networks=1))


class Arm:
    """Holds what a camera reads of the arm, its motion, and how the sensors err.

    Args:
        study: where the recordings are.
    """

    def __init__(self, study: Together):
        self.study, self.surprise = study, SURPRISE
        self.sensor = TrainedSensor(study, study.seed, study.sensor_budget)
        self.roles = self.sensor.roles

    @cached_property
    def known(self) -> list[tuple[Tensor, Tensor]]:
        """Joints and commands of the episodes that are not tested on, ``[T, 7]`` each."""
        data = self.study.data
        numbers = (*self.roles.sensor, *self.roles.tune)
        both = [data.storage[:][key][:, list(JOINTS)] for key in ("state", "action")]
        return [(both[0][at], both[1][at]) for at in (rows_of(data, [number]) for number in numbers)]

    def codes(self, role: str) -> TensorDict:
        """Features of the pictures of a role's episodes ``[N, T]``, the shorter ones filled up."""
        study, sensor = self.study, self.sensor
        file = study.out / "codes" / f"{sensor.name}-{role}-clean.pt"
        hand = None if file.exists() else sensor.hand
        models, numbers = sensor.trained[0], getattr(self.roles, role)
        return read_codes(models, study.data, hand, numbers, condition="clean", exact=True, file=file)

    def readings(self, role: str) -> TensorDict:
        """Camera, joints and commands of the episodes of a role ``[N, T]``."""
        return self.read(self.codes(role))

    @torch.no_grad()
    def read(self, codes: TensorDict) -> TensorDict:
        """Returns what the camera's head makes of features."""
        out, generator = codes.select("valid"), torch.Generator().manual_seed(0)
        samples, encoding = read_code(self.sensor.trained[0], codes["code"], SAMPLES, generator)
        out["camera"], out["encoding"] = samples[..., :SIZE].mean(-2), encoding
        out["camera_observed"] = codes["observed"] & codes["valid"]
        out["state"], out["command"] = codes["truth"][..., :SIZE], codes["command"][..., :SIZE]
        out["regression"] = torch.stack([lagged(one) @ self.follow for one in out["command"]])
        out["regression_observed"] = codes["valid"]
        return out

    @cached_property
    def follow(self) -> Tensor:
        """Least squares of the joints on the last commands, ``[8 * 7 + 1, 7]``."""
        inputs = torch.cat([lagged(command) for _, command in self.known])
        return torch.linalg.lstsq(
            inputs.double(), torch.cat([state for state, _ in self.known]).double()
        ).solution.float()

    @cached_property
    def motion(self) -> Motion:
        """The motion, learned from true states."""
        torch.manual_seed(self.study.seed)
        motion = Motion(self.sensor.trained[1])
        pairs = [(state, state) for state, _ in self.known]
        out = self.study.out / "motions" / "together"
        return train_motion(motion, pairs, out=out, seed=self.study.seed, updates=self.study.motion_updates)

    @cached_property
    def pairs(self) -> list[Tensor]:
        """Joints and rates of the episodes that are not tested on, ``[T, 14]`` each."""
        return [with_rates(state) for state, _ in self.known]

    @property
    def noise(self) -> MappedNoise:
        """Returns the noise of the motion in a row."""
        return unforeseen(self.motion, self.pairs, self.surprise)

    def start(self, begins: bool = True) -> MomentPrior:
        """Returns where episodes begin, or where the arm is at any time; at rest, or nearly."""
        poses = torch.stack([state[0] for state, _ in self.known]) if begins else torch.cat([s for s, _ in self.known])
        rate = self.motion.rate.square().diag()
        mean = torch.cat([poses.mean(0), torch.zeros(SIZE)])
        return MomentPrior(mean, torch.block_diag(poses.mT.cov(), rate if not begins else 0.1 * rate))

    @cached_property
    def unseen(self) -> list[TensorDict]:
        """Readings of the episodes that are not tested on, and that the camera's sensor has not seen."""
        return [self.readings(role) for role in ("tune", "validation")]

    def errors(self, name: str, kind: str = "episodes") -> tuple[FadingBias | None, Tensor]:
        """Estimates a sensor's bias, ``"episodes"`` for a part that is an episode's, and its white noise."""
        errors = [torch.where(one[f"{name}_observed"], one[name] - one["state"], torch.nan) for one in self.unseen]
        every = pad_sequence([error for one in errors for error in one], batch_first=True, padding_value=torch.nan)
        if kind == "white":
            return None, every.square().nanmean((0, 1)).sqrt()
        return FadingBias.from_residuals(every, per_run=kind == "episodes", trainable=False)

    def filter(self, *names: str, begins: bool = True, offset: bool = False, kind: str = "episodes") -> FusedFilter:
        """A filter of sensors of the data; for the kind see :meth:`errors`. Encoders are right, or have an offset."""
        sensors, read = {}, Select(list(range(SIZE)))
        for name in names:
            if name == "encoder":
                error = FadingBias([OFFSET] * SIZE, 1e7, trainable=False) if offset else None
                sensors[name] = FusedSensor(read, [ENCODER] * SIZE, sensor_error=error)
            else:
                error, white = self.errors(name, kind)
                sensors[name] = FusedSensor(read, white, sensor_error=error)
        motion = LearnedTransition(self.motion, residual=False)
        return FusedFilter(motion, sensors, initial=self.start(begins), process_noise=self.noise)


@torch.no_grad()
def unforeseen(motion: nn.Module, pairs: list[Tensor], surprise: float = SURPRISE) -> MappedNoise:
    """Returns the noise of a motion from true states: of the rates, and through them of the joints."""
    missed = torch.cat([one[1:, SIZE:] - motion(one[:-1])[:, SIZE:] for one in pairs])
    root = surprise * torch.linalg.cholesky(missed.mT @ missed / len(missed))
    unit = ConstantNoise([1.0] * SIZE, in_key=("belief", "mean"), out_key=("forecast", "noise"))
    return MappedNoise(unit, torch.cat([root, root]))


def lagged(commands: Tensor) -> Tensor:
    """Commands ``[T, 7]`` of the last rows side by side, and a one, ``[T, 57]``."""
    rows = torch.arange(len(commands))
    parts = [commands[(rows - lag).clamp_min(0)] for lag in range(COMMANDS)]
    return torch.cat([*parts, torch.ones(len(commands), 1)], -1)


@torch.no_grad()
def run(filter: FusedFilter, data: TensorDict) -> tuple[Tensor, Tensor]:
    """Means and standard deviations of the joints ``[N, T, 7]``."""
    belief = filter.sequence(data.exclude("state", "command", "valid").copy())["belief"]
    return belief["mean"][..., :SIZE], belief["var"][..., :SIZE].sqrt()


def score(mean: Tensor, std: Tensor | None, data: TensorDict, at: Tensor) -> list[str]:
    """Mean absolute error in degrees, and what the 90 % intervals hold, at rows ``[N, T]``."""
    error = (mean - data["state"])[at].abs()
    held = "" if std is None else f"{100 * (error < LEVEL * std[at]).float().mean():.0f} %"
    return [f"{error.mean().rad2deg():.2f}", held]


def encoders(data: TensorDict, seconds: float, seed: int = 0) -> TensorDict:
    """The data with an encoder that is read so seldom, from the first row on."""
    out, generator = data.copy(), torch.Generator().manual_seed(seed)
    out["encoder"] = data["state"] + ENCODER * torch.randn(data["state"].shape, generator=generator)
    due = torch.arange(data.shape[1]) % round(seconds * RATE) == 0
    out["encoder_observed"] = due.unsqueeze(-1) & data["valid"]
    return out


def held(data: TensorDict, name: str, start: Tensor) -> Tensor:
    """A sensor's last reading."""
    return hold_last(data[name], data[f"{name}_observed"], start.expand_as(data[name][:, 0]))


def combined(arm: Arm, data: TensorDict) -> Tensor:
    """Least squares of each joint on camera and encoder, and the camera when that was read, from other episodes."""
    start = torch.stack([state[0] for state, _ in arm.known]).mean(0)

    def both(one: TensorDict) -> Tensor:
        camera, encoder = (held(one, name, start) for name in ("camera", "encoder"))
        then = hold_last(camera, one["encoder_observed"], camera[:, 0])
        return torch.stack([camera, encoder, then, torch.ones_like(camera)], -1)

    known = [encoders(one, 1.0) for one in arm.unseen]
    inputs = torch.cat([both(one)[one["valid"].squeeze(-1)] for one in known])
    wanted = torch.cat([one["state"][one["valid"].squeeze(-1)] for one in known])
    weights = torch.linalg.lstsq(inputs.transpose(0, 1), wanted.mT.unsqueeze(-1)).solution.squeeze(-1)  # [7, 4]
    return (both(data) * weights).sum(-1)


def choice(arm: Arm) -> list[str]:
    """The table by which the noise of the motion is chosen: validation episodes, errors of the tuning episodes."""
    data, other = encoders(arm.unseen[1], 1.0), Arm(arm.study)
    other.unseen = arm.unseen[:1]
    lines, at = head("factor", "camera", "within 90 %", "camera, encoders, 1 Hz", "within 90 %"), scored(data)
    for other.surprise in SURPRISES:
        models = other.filter("camera"), other.filter("camera", "encoder")
        lines.append(line(other.surprise, *(cell for model in models for cell in score(*run(model, data), data, at))))
        print(lines[-1], flush=True)
    return lines


def scored(data: TensorDict) -> Tensor:
    """Rows that are scored: all of an episode but the first."""
    at = data["valid"].squeeze(-1).clone()
    at[:, 0] = False
    return at


def rates(arm: Arm) -> list[str]:
    """The table of what is read, and how well the arm is known from it."""
    data = encoders(arm.readings("test"), 1.0)
    start = torch.stack([state[0] for state, _ in arm.known]).mean(0)
    at = scored(data)
    begin = blackouts(data["valid"].sum((1, 2))).unsqueeze(-1)
    step = torch.arange(data.shape[1])
    black = (step >= begin) & (step < begin + 20)
    dark = data.copy()
    dark["camera_observed"] = data["camera_observed"] & ~black.unsqueeze(-1)
    lines = head("read", "by", "error, degrees", "within 90 %", "while 20 frames are black", "within 90 %")

    def add(read: str, by: str, estimate, has_black: bool = True) -> None:
        cells = score(*estimate(data), data, at) + (score(*estimate(dark), data, black) if has_black else ["", ""])
        lines.append(line(read, by, *cells))
        print(lines[-1], flush=True)

    add("camera", "last reading", lambda one: (held(one, "camera", start), None))
    add("camera", "filter", lambda one: run(arm.filter("camera"), one))
    add("encoders, 1 Hz", "last reading", lambda one: (held(one, "encoder", start), None), False)
    add("encoders, 1 Hz", "filter", lambda one: run(arm.filter("encoder"), one), False)
    add("camera, encoders, 1 Hz", "best linear combination", lambda one: (combined(arm, one), None))
    for kind, by in (("white", ", errors white"), ("one", ", errors of one time"), ("episodes", "")):
        model = arm.filter("camera", "encoder", kind=kind)
        add("camera, encoders, 1 Hz", "filter" + by, partial(run, model))
    data["encoder_observed"] = dark["encoder_observed"] = encoders(data, 5.0)["encoder_observed"]
    add("encoders, 0.2 Hz", "last reading", lambda one: (held(one, "encoder", start), None), False)
    add("encoders, 0.2 Hz", "filter", lambda one: run(arm.filter("encoder"), one), False)
    add("camera, encoders, 0.2 Hz", "filter", lambda one: run(arm.filter("camera", "encoder"), one))
    add("last 8 commands", "least squares", lambda one: (one["regression"], None), False)
    add("last 8 commands", "filter", lambda one: run(arm.filter("regression"), one), False)
    add("last 8 commands, camera", "filter", lambda one: run(arm.filter("regression", "camera"), one))
    return lines


def away(arm: Arm) -> list[str]:
    """The table of a camera that is off."""
    data, rows = arm.readings("test"), READ + max(AFTER) + 1
    generator, parts = torch.Generator().manual_seed(5), []
    lengths = data["valid"].sum((1, 2)).tolist()
    long = [number for number, length in enumerate(lengths) if length > rows]
    for _ in range(40):
        one = long[int(torch.randint(len(long), (), generator=generator))]
        begin = int(torch.randint(lengths[one] - rows, (), generator=generator))
        parts.append(data[one, begin : begin + rows])
    windows = torch.stack(parts)
    windows["camera_observed"] = windows["camera_observed"] & (torch.arange(rows) < READ).view(1, -1, 1)
    start = arm.start(False).mean[:SIZE]
    lines = head("belief", *(f"{after / RATE:.0f} s after the last reading" for after in AFTER))
    beliefs = {
        "mean pose": (start.expand_as(windows["state"]), None),
        "last reading": (held(windows, "camera", start), None),
        "filter": run(arm.filter("camera", begins=False), windows),
    }
    for name, (mean, std) in beliefs.items():
        cells = []
        for after in AFTER:
            at = torch.zeros(windows.shape, dtype=torch.bool)
            at[:, READ - 1 + after] = True
            cells.append(", ".join(filter(None, score(mean, std, windows, at))))
        lines.append(line(name, *cells))
        print(lines[-1], flush=True)
    return lines


def offsets(arm: Arm) -> list[str]:
    """The table of encoders that are off by a constant, which the camera finds."""
    data, generator = encoders(arm.readings("test"), 1 / RATE), torch.Generator().manual_seed(0)
    orders = torch.stack([torch.randperm(len(data), generator=generator)[: max(EPISODES)] for _ in range(DRAWS)])
    offset = OFFSET * torch.randn(DRAWS, 1, SIZE, generator=generator)
    last = data["valid"].sum((1, 2)) - 1
    model, simple, lines = (
        arm.filter("camera", "encoder", offset=True),
        [],
        head("episodes", "filter", "within 90 %", "mean difference"),
    )
    errors = torch.where(data["camera_observed"], data["encoder"] - data["camera"], torch.nan).nanmean(1)
    belief = None
    for count in range(max(EPISODES)):
        which = orders[:, count]
        episode = data[which].exclude("state", "command").copy()
        episode["encoder"] = episode["encoder"] + offset
        with torch.no_grad():
            fresh = model.initialise(episode[:, 0].copy())["belief"].select("mean", "cov")
            if belief is not None:  # of the last episode only the offsets are kept
                fresh["mean"][:, -SIZE:] = belief["mean"][:, -SIZE:]
                fresh["cov"][:, -SIZE:, -SIZE:] = belief["cov"][:, -SIZE:, -SIZE:]
            for key in ("mean", "cov"):
                value = fresh[key].unsqueeze(1)
                episode["previous", "belief", key] = value.expand(-1, episode.shape[1], *value.shape[2:])
            out = model.sequence(episode)["belief"]
        belief = out[torch.arange(DRAWS), last[which]]
        simple.append(errors[which])
        if count + 1 in EPISODES:
            wrong = (belief["mean"][:, -SIZE:] - offset.squeeze(1)).abs()
            inside = (wrong < LEVEL * belief["var"][:, -SIZE:].sqrt()).float().mean()
            plain = torch.stack(simple).mean(0).abs().mean().rad2deg()
            lines.append(line(count + 1, f"{wrong.mean().rad2deg():.2f}", f"{100 * inside:.0f} %", f"{plain:.2f}"))
            print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Writes the tables."""
    study = parse(Together)
    torch.set_num_threads(1)
    arm = Arm(study)
    lines = []
    tables = {
        "The noise of the motion, on validation episodes": choice,
        "What is read": rates,
        "A camera that is off": away,
        "Encoders with an offset": offsets,
    }
    for title, table in tables.items():
        lines += [f"**{title}**", "", *table(arm), ""]
    write_page("\n".join([*lines, *made_by("g1.together"), ""]), study.page)


if __name__ == "__main__":
    main()
