"""The sensor, and its training on single frames."""

from __future__ import annotations

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.arm import JOINTS
from benchmarks.common.arm.close_look import CloseLook, GlimpseTrunk
from benchmarks.common.arm.readings import code_of, read_heads
from benchmarks.common.arm.sensors import Statistics, camera_sensor
from benchmarks.g1.disturbances import MARGIN, before_another, disturb
from benchmarks.g1.recordings import FINGERS
from torch_denkf.functional import crps_ensemble
from torch_denkf.modules import ImageSensor, KeypointTrunk

REACH = 0.34  # half a patch's side, in half widths of the image: hand and wrist
SAMPLES = 16  # of a sensor in training
ELSEWHERE = 0.4  # share of the training frames that get the table of another episode
# Units of all losses, the errors of a good sensor: 1.15 degrees; a twentieth of a finger's range.
JOINT_UNIT, FINGER_UNIT = 0.02, 0.05
UNIT = torch.cat([torch.full((JOINTS,), JOINT_UNIT), torch.full((FINGERS,), FINGER_UNIT)])


class HalfKeypointTrunk(KeypointTrunk):
    """Keypoint trunk with 16-bit convolutions, twice as fast on a processor that supports them; places have 32 bits."""

    def forward(self, images: Tensor) -> Tensor:
        """Returns features of images."""
        height, width = images.shape[-2:]
        rows, columns = torch.linspace(-1, 1, height), torch.linspace(-1, 1, width)
        grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy")).expand(len(images), -1, -1, -1)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            fine = self.stem(torch.cat([images, grid], 1))
            last = self.last(fine)
        return self.mix(torch.cat([self.places(fine.float()), self.pool(last.float())], -1))


def build_sensor(facts: Statistics) -> ImageSensor:
    """Builds a sensor of keypoints and a patch around the hand, with a flipout head that learns its noise."""
    keypoints = HalfKeypointTrunk(3, channels=(32, 48, 96, 128), keypoints=64, features=192)
    close = CloseLook(facts.size[1], REACH, dropout=0.2, half=True)
    trunk = GlimpseTrunk(nn.Sequential(nn.AvgPool2d(2), keypoints), close, 192, dropout=0.1, told=True)
    # On one thread of an EPYC an update of 32 frames takes 244 ms with ImageSensor's defaults, 153 ms with these.
    head = {"num_cells": (128, 64), "layer": "flipout", "trunk_memory": 2**34}
    sensor = camera_sensor(facts, trunk, SAMPLES, facts.loc, facts.scale, **head)
    sensor.module["trunk"].to(memory_format=torch.contiguous_format)
    return sensor


class FrameLoss(nn.Module):
    """CRPS of a sensor's samples in units of a good sensor's errors, and the error of its patch's place."""

    def __init__(self, sensor: ImageSensor):
        super().__init__()
        self.sensor = sensor

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """Scores frames ``[N]``."""
        code = code_of([self.sensor], frames["pixels"])
        score = (crps_ensemble(read_heads([self.sensor], code, SAMPLES)[0], frames["target"]) / UNIT).mean(0)
        return {
            "loss_joints": score[:JOINTS].mean(),
            "loss_hand": 0.3 * score[JOINTS:].mean(),
            "loss_place": 3 * (code[:, -2:] - frames["place"]).abs().mean(),
        }


class FramePool:
    """Single frames in memory.

    Args:
        pixels: uint8 ``[N, 3, H, W]``.
        target: true reading, ``[N, 13]``.
        place: of the hand in the image, ``[N, 2]``.
        episode: ``[N]``.
    """

    def __init__(self, pixels: Tensor, target: Tensor, place: Tensor, episode: Tensor):
        self.pixels, self.target, self.place, self.episode = pixels, target, place, episode

    def __len__(self) -> int:
        return len(self.target)

    def rows(self, index: Tensor) -> TensorDict:
        """Returns frames without augmentation, ``[n]``."""
        rows = {"pixels": self.pixels[index].float() / 255, "target": self.target[index], "place": self.place[index]}
        return TensorDict(rows, batch_size=[len(index)])

    def sample(self, generator: torch.Generator, batch: int) -> TensorDict:
        """Returns random augmented frames ``[batch]``, some with the table of another episode."""
        index = torch.randint(len(self), (batch,), generator=generator)
        rows = {"target": self.target[index], "place": self.place[index]}
        pixels, moved = disturb(self._elsewhere(index, generator), self.place[index], generator)
        rows["place"] = rows["place"] + moved
        return TensorDict({**rows, "pixels": pixels}, batch_size=[batch])

    def _elsewhere(self, index: Tensor, generator: torch.Generator) -> Tensor:
        # A sensor could recognise its few episodes by their tables. Most other hands are at about the same place.
        pixels = self.pixels[index]
        for k in (torch.rand(len(index), generator=generator) < ELSEWHERE).nonzero().flatten().tolist():
            others = torch.randint(len(self), (400,), generator=generator)
            near, least = torch.rand(2, generator=generator).tolist()
            away = (self.place[others] - self.place[index[k]]).norm(dim=-1)
            away = away + 10 * (self.episode[others] == self.episode[index[k]])
            other = others[away.argmin()] if near < 0.7 else others[0]
            margin = MARGIN[0] + (MARGIN[1] - MARGIN[0]) * least
            pixels[k] = before_another(pixels[k], self.place[index[k]], self.pixels[other], margin)
        return pixels
