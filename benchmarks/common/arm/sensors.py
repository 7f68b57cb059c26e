"""Camera sensors of arms: statistics of their data, their construction, and their training on single frames."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.arm import JOINTS
from torch_denkf.modules import ImageSensor
from torch_denkf.training import Stage
from torch_denkf.training.parts import train_part


class Frames(Protocol):
    """Single frames in memory."""

    def __len__(self) -> int:
        """Returns N."""

    def rows(self, index: Tensor) -> TensorDict:
        """Returns frames with float pixels, and the entries that a loss compares."""


@dataclass
class Statistics:
    """Means and standard deviations of the training sequences alone."""

    loc: Tensor  # mean of the components that the sensor reads, [D]
    scale: Tensor  # their standard deviation
    rate: Tensor  # root mean square of the first difference of each joint, [7] rad
    acceleration: Tensor  # of the second difference
    jerk: Tensor  # of the third difference
    pixel_loc: Tensor
    pixel_scale: Tensor
    size: tuple[int, int]  # of the images, (height, width)

    @classmethod
    def of(cls, sequences: Sequence[Tensor], pixels: Tensor) -> Statistics:
        """Returns the statistics of sequences of true values ``[T, D]``, and of images, uint8."""
        flat, some = torch.cat(list(sequences)), pixels[:: max(len(pixels) // 500, 1)].float() / 255
        rates = [
            torch.cat([one[:, :JOINTS].diff(dim=0, n=order) for one in sequences]).square().mean(0).sqrt()
            for order in (1, 2, 3)
        ]
        size = int(pixels.shape[-2]), int(pixels.shape[-1])
        units = flat.std(0).clamp_min(1e-3), *(rate.clamp_min(1e-5) for rate in rates)
        return cls(flat.mean(0), *units, some.mean((0, 2, 3)), some.std((0, 2, 3)), size)


def camera_sensor(facts: Statistics, trunk: nn.Module, samples: int, loc: Tensor, scale: Tensor, **head) -> ImageSensor:
    """Returns a sensor whose outputs are normalised by ``loc`` and ``scale``."""
    return ImageSensor(
        len(loc),
        image_shape=(3, *facts.size),
        trunk=trunk,
        ensemble_size=samples,
        loc=loc,
        scale=scale,
        pixel_loc=facts.pixel_loc,
        pixel_scale=facts.pixel_scale,
        encoding_key=("sensor", "encoding"),
        **head,
    )


@torch.no_grad()
def clean_loss(sensor: ImageSensor, loss: nn.Module, held_out: Frames) -> float:
    """Returns the loss of frames without augmentation, with the same seed in each call."""
    training, values = sensor.training, []
    sensor.eval()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for index in torch.arange(len(held_out)).split(128):
            values.append(len(index) * sum(loss(held_out.rows(index)).values()))
    sensor.train(training)
    return float(sum(values)) / len(held_out)


def train_sensor(
    sensor: ImageSensor,
    loss: nn.Module,
    sample: Callable[[torch.Generator], TensorDict],
    held_out: Frames,
    *,
    out: Path,
    seed: int,
    updates: int,
    lr: float,
    weight_decay: float,
) -> ImageSensor:
    """Trains a sensor, resumes its training, or loads it if it was trained before.

    Args:
        sensor: trained in place.
        loss: maps frames to terms.
        sample: draws training frames.
        held_out: validation frames.
        out: folder for checkpoints and logs.
        seed: of all random numbers.
        updates: number of updates.
        lr: learning rate.
        weight_decay: of the optimiser.
    """
    stage = Stage("sensor", loss, lambda generator, _: sample(generator), updates, lr=lr, weight_decay=weight_decay)
    return train_part(
        sensor,
        stage,
        out=out,
        validate=lambda: {"loss": clean_loss(sensor, loss, held_out)},
        monitor="loss",
        validate_every=max(updates // 8, 1),
        save_every=200,
        seed=seed,
        device="cpu",
    ).eval()
