"""Splits drives into training, tuning, validation and test, and draws batches of their frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from tensordict import TensorDict

from benchmarks.kitti.streams import DISTURBANCES, LONGEST, Stream, read_by
from torch_denkf.applications.car.odometry.batches import PairSampler
from torch_denkf.applications.car.odometry.streams import rows

VELOCITIES = [3, 4]  # dimensions of v and theta_dot in [x, y, theta, v, theta_dot]
# Errors of a good sensor in (v, theta_dot), in standard deviations over the training drives: units of the losses.
UNITS = (0.1, 0.03)


@dataclass
class Statistics:
    """Means and standard deviations of the training drives alone."""

    loc: torch.Tensor  # of (v m/s, theta_dot rad/s); 0 for theta_dot, because every drive is also used mirrored
    scale: torch.Tensor
    pixel_loc: torch.Tensor  # of a grey frame and of its difference to the one before
    pixel_scale: torch.Tensor
    dt: float  # s

    @property
    def unit(self) -> torch.Tensor:
        """Returns the units of the errors, in (m/s, rad/s)."""
        return self.scale * torch.tensor(UNITS)


@dataclass(frozen=True)
class Part:
    """A part of a stream, with its weight in the batches."""

    stream: Stream
    begin: float = 0.0  # shares of its rows
    end: float = 1.0
    weight: float = 1.0

    @property
    def steps(self) -> int:
        """Returns the steps between the two frames of a pair."""
        return self.stream.steps

    def read(self, cache: Path) -> TensorDict:
        """Returns the rows of the part, ``[n]``."""
        data = self.stream.read(cache)
        return data[int(self.begin * len(data)) : int(self.end * len(data))]


@dataclass(frozen=True)
class Fold:
    """Split of the drives with one test drive, which may not be in the other lists.

    The filter is tuned on drives that its sensor was not trained on, so that it learns the sensor's errors on new
    drives; see ``SensorTraining.unseen_readings`` for drives that are in both lists.
    """

    name: str
    train: list[Part]  # of the sensor
    tune: list[Part]  # of the filter
    validation: list[Part]
    test: list[Stream] = field(default_factory=list)

    def __post_init__(self):
        tested = {stream.drive for stream in self.test}
        leaked = {part.stream.drive for part in (*self.train, *self.tune, *self.validation)} & tested
        if leaked:
            raise ValueError(f"fold {self.name}: {sorted(leaked)} are in both training and test")

    @property
    def trained(self) -> set[str]:
        """Returns the drives that train the sensor."""
        return {part.stream.drive for part in self.train}

    @property
    def shared(self) -> set[str]:
        """Returns drives for both sensor and filter."""
        return self.trained & {part.stream.drive for part in self.tune}


def with_disturbances(parts: Sequence[Part]) -> list[Part]:
    """Returns each part clean, and disturbed with half of its weight over all disturbances."""
    disturbed = []
    for part in parts:
        disturbed.append(part)
        for condition in DISTURBANCES:
            stream = replace(part.stream, condition=condition)
            disturbed.append(replace(part, stream=stream, weight=0.5 * part.weight / len(DISTURBANCES)))
    return disturbed


def with_spans(parts: Sequence[Part]) -> list[Part]:
    """Returns each clean part, and with less weight in pairs of two and of three steps."""
    longer = [
        replace(part, stream=replace(part.stream, steps=steps), weight=weight * part.weight)
        for part in parts
        for steps, weight in ((2, 0.25), (3, 0.12))
        if part.stream.condition == "clean"
    ]
    return [*parts, *longer]


def make_fold(test: str, streams: Sequence[Stream], train: Sequence[Part], held_out: Sequence[Part]) -> Fold:
    """Returns the fold with ``test`` left out.

    The other drives train both sensor and filter, see ``SensorTraining.unseen_readings``. Validation uses rendered
    drives or, without them, the drive that follows the test drive.
    """
    drives = list(dict.fromkeys(stream.drive for stream in streams))
    of = {drive: [stream for stream in streams if stream.drive == drive] for drive in drives}
    at = drives.index(test)
    others = [*drives[at + 1 :], *drives[:at]]

    def parts(names: Sequence[str]) -> list[Part]:
        return [Part(s, weight=1 / len(names) / len(of[name])) for name in names for s in of[name]]

    if len(others) < 2 + (not held_out):
        raise ValueError(f"{len(drives)} drives are too few to leave {test} out; add drives, or --rendered ones")
    own = parts(sorted(others if held_out else others[1:], key=lambda name: -_rows(of[name][0])))
    if not held_out:
        checked = parts(others[:1])
        return Fold(test, with_spans(with_disturbances(own)), *map(with_disturbances, (own, checked)), test=of[test])
    rendered = [replace(part, weight=1.5 / len(train)) for part in train]
    checked = [replace(part, weight=1 / len(held_out)) for part in held_out]
    sensor = with_spans([*with_disturbances(own), *with_disturbances(rendered)])
    tune = [*own, *(replace(part, weight=0.3 * part.weight) for part in checked)]
    return Fold(test, sensor, with_disturbances(tune), with_disturbances(checked), test=of[test])


def _rows(stream: Stream) -> int:
    return sum(1 for _ in (Path(stream.root) / "sequences" / stream.drive / stream.camera).glob("*.png"))


def statistics(parts: Sequence[Part], cache: Path) -> Statistics:
    """Returns means and standard deviations over clean training drives and their mirror images."""
    data = [part.read(cache) for part in parts if part.stream.condition == "clean" and part.stream.steps == 1]
    velocity = torch.cat([part["state"][:, VELOCITIES] for part in data])
    loc, scale = velocity.mean(0), velocity.std(0)
    loc[1], scale[1] = 0.0, velocity[:, 1].square().mean().sqrt()
    some = [torch.arange(1, len(part), max(len(part) // 50, 1)) for part in data]
    frames = [rows(read_by("image", part), at, LONGEST)["pixels"] for part, at in zip(data, some, strict=True)]
    frames = torch.cat(frames)
    dt = torch.stack([part["dt"][0, 0] for part in data])
    if (dt / dt[0] - 1).abs().max() > 0.01:
        raise ValueError(f"the drives have frame times of {dt.unique().tolist()} s; a study needs equal ones")
    return Statistics(loc, scale, frames.mean((0, 2, 3)), frames.std((0, 2, 3)), float(dt[0]))


def frame_sampler(parts: Sequence[Part], cache: Path, sensor: str) -> PairSampler:
    """Returns a sampler of single frames, or windows, from the streams, for training that involves the sensor."""
    parts = [part for part in parts if part.steps == 1 or sensor == "flow"]
    return PairSampler(parts, [read_by(sensor, part.read(cache)) for part in parts], LONGEST)
