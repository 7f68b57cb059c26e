"""Batches for the training of a car filter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.applications.car.kitti.frames import mark_start
from torch_denkf.applications.car.kitti.gaps import steps_between
from torch_denkf.applications.car.odometry.filter import VELOCITIES
from torch_denkf.applications.car.odometry.streams import Drive, mirror, rows, take_spans

__all__ = ["PairSampler", "ReadingSampler", "mark_start"]

_GROUPS = 8  # drives per batch for the sensor, windows per batch for the whole filter


class PairSampler:
    """Draws pairs of frames, or windows, of drives, for training with the sensor.

    Args:
        drives: drives to draw from, by their weights.
        data: frames of each drive, ``[N]``.
        longest: largest number of steps between the two frames of a pair.
    """

    def __init__(self, drives: Sequence[Drive], data: Sequence[TensorDict], longest: int):
        self.data, self.longest = list(data), longest
        self.weight = torch.tensor([drive.weight for drive in drives])
        self.neighbours = torch.tensor([drive.steps == 1 for drive in drives])

    def frames(self, generator: torch.Generator, batch: int = 64) -> TensorDict:
        """Returns frames ``[batch]``; every second group is mirrored."""
        chosen: list[TensorDict] = []
        for number in torch.multinomial(self.weight, _GROUPS, replacement=True, generator=generator).tolist():
            data = self.data[number]
            index = torch.randint(1, len(data), (batch // _GROUPS,), generator=generator)
            frames = rows(data, index, self.longest)
            chosen.append(mirror(frames) if len(chosen) % 2 else frames)
        return TensorDict.cat(chosen)

    def windows(self, generator: torch.Generator, length: int | None, start_std: Tensor) -> TensorDict:
        """Returns windows ``[8, length]`` with a noisy initial state."""
        weight = self.weight * self.neighbours
        chosen: list[TensorDict] = []
        for number in torch.multinomial(weight, _GROUPS, replacement=True, generator=generator).tolist():
            data = self.data[number]
            if length is None or len(data) <= length:
                raise ValueError(f"windows of {length} frames do not fit in a drive of {len(data)}; pass longer drives")
            first = int(torch.randint(1, len(data) - length + 1, (), generator=generator))
            frames = rows(data, torch.arange(first, first + length), self.longest)
            chosen.append(mirror(frames) if len(chosen) % 2 else frames)
        return with_start(TensorDict.stack(chosen), start_std, generator)


class ReadingSampler:
    """Draws windows of a frozen sensor's readings.

    Args:
        readings: readings of each drive, ``[N]``, see :func:`torch_denkf.applications.car.odometry.streams.read_spans`.
        weights: shares of the drives in the batches.
        length: steps of a window.
        gain_error: standard deviation of the logarithm of a gain on all speeds of a window, for unknown errors of the
            camera's height and pitch.

    Raises:
        ValueError: if all drives are shorter than a window.
    """

    def __init__(self, readings: Sequence[TensorDict], weights: Sequence[float], length: int, gain_error: float):
        self.readings, self.length, self.gain_error = TensorDict.cat(list(readings)), length, gain_error
        starts, weight, offset = [], [], 0
        for reading, share in zip(readings, weights, strict=True):
            count = len(reading) - length
            if count > 0:  # row 0 has no reading
                starts.append(offset + 1 + torch.arange(count))
                weight.append(torch.full((count,), share / count))
            offset += len(reading)
        if not starts:
            frames = [len(reading) for reading in readings]
            raise ValueError(
                f"windows of {length} steps do not fit in drives of {max(frames)} frames; pass longer drives or a "
                "smaller length"
            )
        self.starts, self.weight = torch.cat(starts), torch.cat(weight)

    def windows(self, generator: torch.Generator, start_std: Tensor, batch: int = 48) -> TensorDict:
        """Draws windows ``[batch, length]``, scales their speeds, and drops up to half of the frames."""
        start = self.starts[torch.multinomial(self.weight, batch, replacement=True, generator=generator)]
        windows = self.readings[start.unsqueeze(-1) + torch.arange(self.length)]
        # Few drives have few speeds, to which the transition would learn to regress.
        low, high = torch.tensor([-1.0, -0.7]), torch.tensor([0.7, 0.7])
        speed = (low + (high - low) * torch.rand(batch, 1, 2, generator=generator)).exp()
        gain = (self.gain_error * torch.tensor([1.0, 0.3]) * torch.randn(batch, 1, 2, generator=generator)).exp()
        share = 0.5 * torch.rand(batch, 1, generator=generator)
        kept = torch.rand(batch, self.length + 1, generator=generator) >= share
        longest = self.readings["spans"].shape[-1]
        windows = take_spans(windows, steps_between(kept, longest)[:, 1:])
        windows["state"][..., VELOCITIES] *= speed
        windows["sensor", "ensemble"] *= (speed * gain).unsqueeze(-2)
        return with_start(windows, start_std, generator)


def with_start(windows: TensorDict, start_std: Tensor, generator: torch.Generator) -> TensorDict:
    """Adds noise to the start of windows, so that the filter does not learn to trust its forecast only."""
    windows["start"] = windows["state"] + start_std * torch.randn(len(windows), 1, 5, generator=generator)
    return mark_start(windows)
