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

REACH = 0.34  # half a patch's side, in half widths of the picture: hand and wrist
SAMPLES = 16  # of a sensor while it is trained
ELSEWHERE = 0.4  # of the training frames are put before the table of another episode
# What a good sensor leaves: units of all losses. 1.15 degrees; a twentieth of the way of a finger.
JOINT_UNIT, FINGER_UNIT = 0.02, 0.05
UNIT = torch.cat([torch.full((JOINTS,), JOINT_UNIT), torch.full((FINGERS,), FINGER_UNIT)])


class HalfKeypointTrunk(KeypointTrunk):
    """Keypoints with convolutions of 16 bits: half the time on a processor that has them. Places keep 32 bits."""

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
    """Builds keypoints and a second look at the hand. Flipout learns how large its noise is."""
    keypoints = HalfKeypointTrunk(3, channels=(32, 48, 96, 128), keypoints=64, features=192)
    close = CloseLook(facts.size[1], REACH, dropout=0.2, half=True)
    trunk = GlimpseTrunk(nn.Sequential(nn.AvgPool2d(2), keypoints), close, 192, dropout=0.1, told=True)
    # Measured on one thread of an EPYC: 244 ms an update of 32 frames as ImageSensor has it by default, 153 like this.
    head = {"num_cells": (128, 64), "layer": "flipout", "trunk_memory": 2**34}
    sensor = camera_sensor(facts, trunk, SAMPLES, facts.loc, facts.scale, **head)
    sensor.module["trunk"].to(memory_format=torch.contiguous_format)
    return sensor


class FrameLoss(nn.Module):
    """CRPS of a sensor's samples in units of a good sensor's errors; and where it looks closely."""

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
        target: what is to be read, ``[N, 13]``.
        place: where the hand is in the picture, ``[N, 2]``.
        episode: ``[N]``.
    """

    def __init__(self, pixels: Tensor, target: Tensor, place: Tensor, episode: Tensor):
        self.pixels, self.target, self.place, self.episode = pixels, target, place, episode

    def __len__(self) -> int:
        return len(self.target)

    def rows(self, index: Tensor) -> TensorDict:
        """Returns frames as they are, ``[n]``."""
        rows = {"pixels": self.pixels[index].float() / 255, "target": self.target[index], "place": self.place[index]}
        return TensorDict(rows, batch_size=[len(index)])

    def sample(self, generator: torch.Generator, batch: int) -> TensorDict:
        """Returns random disturbed frames ``[batch]``, some before the table of another episode."""
        index = torch.randint(len(self), (batch,), generator=generator)
        rows = {"target": self.target[index], "place": self.place[index]}
        pixels, moved = disturb(self._elsewhere(index, generator), self.place[index], generator)
        rows["place"] = rows["place"] + moved
        return TensorDict({**rows, "pixels": pixels}, batch_size=[batch])

    def _elsewhere(self, index: Tensor, generator: torch.Generator) -> Tensor:
        # A sensor knows its few episodes by their tables. Most of the others' hands are at about the same place.
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
