"""Loads the recordings of the study, and splits whole episodes into training, tuning, validation and test sets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arm import Roles
from torch_denkf.data import LeRobotReplay
from torch_denkf.data.episodes import hashed_share
from torch_denkf.data.lerobot.recording import DecodedRecording
from torch_denkf.data.lerobot.replay import is_for_tests
from torch_denkf.data.lerobot.rows import recording_from_rows

ARM, HAND = range(7, 14), range(20, 26)  # of the robot's 26 components: right arm (rad), right hand (0 to 1)
FINGERS = len(HAND)
READ = len(ARM) + FINGERS  # components of a sensor's reading: arm, then hand
NAMES = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll", "wrist_pitch", "wrist_yaw")


@dataclass(frozen=True)
class Recordings:
    """Options of the recordings."""

    root: Path = Path("../shared/data/g1")  # LeRobot folder
    out: Path = Path("runs/g1")  # checkpoints, logs, table, beliefs, decoded pictures
    size: tuple[int, int] = (180, 240)  # of the pictures, (height, width)
    tune: int = 6  # episodes that train the filters, and not the sensor
    validation: int = 5  # validation episodes, which train neither
    drawn: bool = False  # synthetic images instead of the folder

    @cached_property
    def data(self) -> LeRobotReplay:
        """Returns all episodes, with repeats masked."""
        source = drawn_recording(self.size) if self.drawn else self.root
        return LeRobotReplay(source, size=self.size, split="all", repeats="mask", cache=self.out / "cache")

    def roles(self, seed: int) -> Roles:
        """Returns the split of the episodes for a seed; the test episodes are the same for all seeds."""
        tests = {e.number for e in self.data.episodes if is_for_tests(e.number)}
        rest = [e.number for e in self.data.episodes if e.number not in tests]
        drawn = sorted(rest, key=lambda number: hashed_share(str(number), f"g1 {seed}"))
        held = self.tune + self.validation
        return Roles(
            sorted(drawn[held:]), sorted(drawn[self.validation : held]), sorted(drawn[: self.validation]), sorted(tests)
        )


def rows_of(data: LeRobotReplay, numbers: list[int]) -> Tensor:
    """Returns the indices of the rows of some episodes, ``[n]``."""
    wanted = set(numbers)
    return torch.cat([torch.arange(e.start, e.start + e.length) for e in data.episodes if e.number in wanted])


def bytes_of(data: LeRobotReplay, rows: Tensor) -> Tensor:
    """Returns the images of some rows, uint8 ``[n, 3, H, W]``."""
    return torch.cat([(data[part]["pixels"] * 255).round().to(torch.uint8) for part in rows.split(256)])


def targets(rows: TensorDict) -> Tensor:
    """Returns the training targets of a sensor: arm and hand, ``[*, 13]``."""
    return torch.cat([rows["state"][..., list(ARM)], rows["state"][..., list(HAND)]], -1)


def drawn_recording(size: tuple[int, int], episodes: int = 20, length: int = 45) -> DecodedRecording:
    """Returns a synthetic recording: joint angles place a dark spot and its shadow in each image."""
    generator, phases = torch.Generator().manual_seed(0), torch.arange(length) / length
    states, pictures = [], []
    down, right = torch.linspace(-1, 1, size[0]).view(-1, 1), torch.linspace(-1, 1, size[1])
    for _ in range(episodes):
        swing = 0.3 * torch.rand(26, generator=generator) + 0.1
        state = swing * (6.3 * phases.unsqueeze(-1) + 0.5 * torch.rand(26, generator=generator)).sin()
        place = state[:, [7, 8, 10, 13]].view(length, 4, 1, 1)
        spots = [((down - place[:, k]) ** 2 + (right - place[:, k + 1]) ** 2) / 0.05 for k in (0, 2)]
        grey = 200 - 90 * (-spots[0]).exp() - 60 * (-spots[1]).exp()
        grey[3::4] = grey[2:-1:4]  # every fourth image is a repeat
        states.append(state)
        pictures.append(grey.round().to(torch.uint8).unsqueeze(1).expand(-1, 3, -1, -1))
    rows = {
        "observation": {"image": torch.cat(pictures), "state": torch.cat(states)},
        "action": torch.cat(states).roll(-2, 0),
        "episode": torch.arange(episodes).repeat_interleave(length),
    }
    return recording_from_rows(TensorDict(rows, batch_size=[episodes * length]), fps=30.0)
