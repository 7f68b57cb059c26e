"""The sensor, and its training on single frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.arm import JOINTS
from benchmarks.common.arm.readings import code_of, read_heads
from benchmarks.g1.disturbances import MARGIN, before_another, disturb
from benchmarks.g1.recordings import FINGERS, READ
from benchmarks.g1.trunk import SecondLookTrunk
from torch_denkf.functional import crps_ensemble
from torch_denkf.modules import ImageSensor
from torch_denkf.training import Stage
from torch_denkf.training.parts import train_part

SAMPLES = 16  # of a sensor while it is trained
ELSEWHERE = 0.4  # of the training frames are put before the table of another episode
# What a good sensor leaves: units of all losses. 1.15 degrees; a twentieth of the way of a finger.
JOINT_UNIT, FINGER_UNIT = 0.02, 0.05
UNIT = torch.cat([torch.full((JOINTS,), JOINT_UNIT), torch.full((FINGERS,), FINGER_UNIT)])


@dataclass
class Statistics:
    """Means and standard deviations of the training episodes alone."""

    loc: Tensor  # of arm and hand, [13]
    scale: Tensor
    rate: Tensor  # root mean square of a number's change in a row
    acceleration: Tensor  # of the change's change
    pixel_loc: Tensor
    pixel_scale: Tensor
    size: tuple[int, int]

    @classmethod
    def of(cls, sequences: list[Tensor], pixels: Tensor) -> Statistics:
        """Takes statistics of true numbers of episodes ``[T, 13]`` and of pictures, uint8."""
        flat, some = torch.cat(sequences), pixels[:: max(len(pixels) // 300, 1)].float() / 255
        rates = [one.diff(dim=0) for one in sequences]
        rate = torch.cat(rates).square().mean(0).sqrt().clamp_min(1e-4)
        acceleration = torch.cat([one.diff(dim=0) for one in rates]).square().mean(0).sqrt().clamp_min(1e-4)
        scale, size = flat.std(0).clamp_min(1e-3), (int(pixels.shape[-2]), int(pixels.shape[-1]))
        return cls(flat.mean(0), scale, rate, acceleration, some.mean((0, 2, 3)), some.std((0, 2, 3)), size)


def build_sensor(facts: Statistics) -> ImageSensor:
    """Builds keypoints and a second look at the hand. Flipout learns how large its noise is."""
    # Measured on one thread of an EPYC: 244 ms an update of 32 frames as ImageSensor has it by default, 153 like this.
    sensor = ImageSensor(
        READ,
        image_shape=(3, *facts.size),
        trunk=SecondLookTrunk(facts.size[1]),
        ensemble_size=SAMPLES,
        loc=facts.loc,
        scale=facts.scale,
        pixel_loc=facts.pixel_loc,
        pixel_scale=facts.pixel_scale,
        encoding_key=("sensor", "encoding"),
        num_cells=(128, 64),
        layer="flipout",
        trunk_memory=2**34,
    )
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

    def sample(self, generator: torch.Generator, batch: int) -> TensorDict:
        """Random disturbed frames ``[batch]``, some before the table of another episode."""
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


@torch.no_grad()
def sensor_error(sensor: ImageSensor, pool: FramePool) -> dict[str, float]:
    """CRPS in the same units, and mean absolute errors: degrees of the arm, hundredths of the hand."""
    sensor.eval()
    scores, errors = [], []
    generator = torch.Generator().manual_seed(0)
    for index in torch.arange(len(pool)).split(128):
        samples, _ = read_heads([sensor], code_of([sensor], pool.pixels[index].float() / 255), SAMPLES, generator)
        scores.append(crps_ensemble(samples, pool.target[index]) / UNIT)
        errors.append((samples.mean(-2) - pool.target[index]).abs())
    sensor.train()
    score, error = torch.cat(scores).mean(0), torch.cat(errors).mean(0)
    named = {"crps": float(score[:JOINTS].mean() + 0.3 * score[JOINTS:].mean())}
    return {**named, "joint_mae_deg": float(error[:JOINTS].rad2deg().mean()), "hand_mae": float(error[JOINTS:].mean())}


def train_sensor(
    sensor: ImageSensor, train: FramePool, held_out: FramePool, *, out: Path, seed: int, updates: int, batch: int
) -> ImageSensor:
    """Trains a sensor, or goes on where that was broken off, or reads it where it was done."""
    stage = Stage(
        "sensor",
        FrameLoss(sensor),
        lambda generator, _: train.sample(generator, batch),
        updates,
        lr=2e-3,
        weight_decay=0.05,
    )
    return train_part(
        sensor,
        stage,
        out=out,
        validate=lambda: sensor_error(sensor, held_out),
        monitor="crps",
        validate_every=max(updates // 6, 1),
        save_every=250,
        seed=seed,
        device="cpu",
    ).eval()
