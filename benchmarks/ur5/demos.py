"""The collections of the study, and their split by demo into training, tuning, validation and test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import avg_pool2d

from benchmarks.common.arm import Roles
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos

STATE = 10  # J1..J6 rad, J7 the gripper's opening rad, x, y, z m


@dataclass(frozen=True)
class Collections:
    """Demos of the study: few frames of many in the simulator, whole sequences of some in both domains.

    Demo i of the first two collections is the same episode. The replay's hash assigns demos to the test; of the
    others, the first numbers are sequences for the filter, without training of the sensor, so that the filter learns
    the sensor's errors on new demos; all the rest train the sensor.
    """

    root: Path = Path("runs/ur5-demos")  # folder of the demos
    out: Path = Path("runs/ur5")  # checkpoints, logs, table, beliefs, decoded pictures
    size: int = 224  # side of the images in pixels
    demos: int = 2000  # in the simulator, few frames each
    frames: int = 16  # drawn at random steps of each
    sequences: int = 220  # number of these demos that are stored whole
    tune: int = 80  # at most, of these, for training the filters
    validation: int = 16  # at most, of these, for validation
    real: int = 130  # whole demos of real_like
    real_train: int = 20  # of these, on the train side
    pasted: int = 8000  # images of the simulator's states for real_like's camera, to fine-tune with
    steps: int = 350  # of a sequence

    def collect(self, processes: int = 1, *, real: bool = True) -> None:
        """Collects the missing demos, of ``real_like`` only with ``real``."""
        common = {"size": (self.size, self.size), "processes": processes, "max_steps": self.steps}
        collect_ur5_demos(self.root / "sim-frames", self.demos, frames=self.frames, **common)
        collect_ur5_demos(self.root / "sim-sequences", self.sequences, **common)
        if real:
            collect_ur5_demos(self.root / "real_like-sequences", self.real, domain="real_like", **common)

    def replay(self, name: str, split: str, **kwargs) -> UR5ExperienceReplay:
        """Returns one collection: ``"sim-frames"``, ``"sim-sequences"`` or ``"real_like-sequences"``."""
        return UR5ExperienceReplay(self.root / name, split=split, cache=self.out / "cache", **kwargs)


def sequences_of(data: UR5ExperienceReplay, first: int) -> Tensor:
    """Returns states ``[N, T, 10]`` of demos from number ``first`` on, without images."""
    parts = [data.storage[e.start : e.start + e.length]["state"] for e in data.episodes if e.demo >= first]
    return torch.stack(parts)


@dataclass
class FramePool:
    """Single frames in memory: images, uint8 ``[N, 3, H, W]``, and their states ``[N, 10]``."""

    pixels: Tensor
    state: Tensor

    @classmethod
    def of(cls, data: UR5ExperienceReplay, chosen: Sequence[int]) -> FramePool:
        """Returns the frames of chosen demos, from a replay with ``frames_only``."""
        wanted = torch.tensor([episode.demo in chosen for episode in data.episodes])
        rows = wanted[data.storage[:]["episode"]].nonzero().squeeze(-1)
        if not len(rows):
            raise ValueError(f"none of the {len(data.episodes)} demos in {data.root} is chosen; collect more")
        first = data[rows[:1]]
        pixels = torch.empty(len(rows), *first["pixels"].shape[1:], dtype=torch.uint8)  # as floats: 17 GB
        for at in torch.arange(len(rows)).split(512):
            pixels[at] = (data[rows[at]]["pixels"] * 255).round().to(torch.uint8)
        return cls(pixels, data.storage[:]["state"][rows])

    def __len__(self) -> int:
        return len(self.state)

    def shrunk(self, times: int) -> FramePool:
        """Returns the frames downsampled by a factor ``times`` in rows and columns, by averaging."""
        parts = [avg_pool2d(part.float(), times).round().to(torch.uint8) for part in self.pixels.split(512)]
        return FramePool(torch.cat(parts), self.state)

    def rows(self, index: Tensor) -> TensorDict:
        """Returns frames with float pixels, ``[n]``."""
        pixels = self.pixels[index].float() / 255
        return TensorDict({"pixels": pixels, "state": self.state[index]}, batch_size=[len(index)])

    def sample(self, generator: torch.Generator, batch: int) -> TensorDict:
        """Returns random frames ``[batch]``."""
        return self.rows(torch.randint(len(self), (batch,), generator=generator))


def _numbers(collections: Collections, name: str, split: str, end: int) -> list[int]:
    """Returns the demos of one side with numbers below ``end``: the folder may have further ones."""
    return [episode.demo for episode in collections.replay(name, split).episodes if episode.demo < end]


def sim_roles(collections: Collections) -> Roles:
    """Returns the roles in the simulator."""
    frames = collections.replay("sim-frames", "train", frames_only=True)
    sequences = _numbers(collections, "sim-sequences", "train", collections.sequences)
    test = _numbers(collections, "sim-sequences", "test", collections.sequences)
    held = min(max(len(sequences) // 7, 1), collections.validation)
    sensor = [e.demo for e in frames.episodes if e.demo >= collections.sequences]
    return Roles(sensor, sequences[:-held][: collections.tune], sequences[-held:], test)


def real_roles(collections: Collections) -> Roles:
    """Returns the roles in ``real_like``: of the few demos on the train side, two thirds train the sensor."""
    train = _numbers(collections, "real_like-sequences", "train", collections.real)[: collections.real_train]
    test = _numbers(collections, "real_like-sequences", "test", collections.real)
    own = max(len(train) * 7 // 10, 1)
    held = max((len(train) - own) // 3, 1)
    return Roles(train[:own], train[own:-held], train[-held:], test)
