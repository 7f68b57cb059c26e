"""A frozen sensor's readings of whole streams, with and without missing frames; and windows of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.kitti.folds import VELOCITIES, Part, with_start
from benchmarks.kitti.streams import LONGEST, MISSING, mirror, rows, spans
from torch_denkf.data import steps_between
from torch_denkf.modules import SubModel


@torch.no_grad()
def read_sensor(sensor: SubModel, data: TensorDict, kind: str, mirrored: bool = False, chunk: int = 256) -> TensorDict:
    """A sensor's readings of a whole stream ``[N]``, from the same random numbers each time."""
    readings = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        was_training = sensor.training
        sensor.eval()
        for index in torch.arange(len(data)).split(chunk):
            frames = rows(data, index, kind)
            readings.append(sensor(mirror(frames) if mirrored else frames).exclude("flow", "road", "pixels"))
        sensor.train(was_training)
    return torch.cat(readings)


def read_spans(sensor: SubModel, part: Part, cache: Path, kind: str, mirrored: bool = False) -> TensorDict:
    """A sensor's readings of a part ``[N]``, of pairs of 1, 2, ... steps: ``("spans", ...)`` ``[N, LONGEST]``.

    Those that were not computed are not observed.
    """
    parts = [replace(part, stream=stream) for stream in spans(part.stream, kind)]
    read = [read_sensor(sensor, each.read(cache), kind, mirrored) for each in parts]
    entries = {
        "observed": [each["observed"] for each in read],
        "ensemble": [each["sensor", "ensemble"] for each in read],
        "encoding": [each["sensor", "encoding"] for each in read],
    }
    blank = LONGEST - len(read)
    stacked = {
        key: torch.stack([*values, *[torch.zeros_like(values[0])] * blank], 1) for key, values in entries.items()
    }
    size = (len(read[0]), LONGEST)
    return TensorDict({"state": read[0]["state"], "spans": TensorDict(stacked, batch_size=size)}, batch_size=size[:1])


def take_spans(readings: TensorDict, steps: Tensor) -> TensorDict:
    """Of readings of pairs of 1, 2, ... steps ``[*B, K]``, those of ``steps`` ``[*B]``; none where that is 0.

    A copy, with ``"observed"`` and ``"steps"`` ``[*B, 1]``.
    """
    spans = readings["spans"]
    index = (steps - 1).clamp(0, spans.shape[-1] - 1).unsqueeze(-1)
    taken = {}
    for key in ("observed", "ensemble", "encoding"):
        value = spans[key]
        where = index.reshape(*index.shape, *[1] * (value.ndim - index.ndim))
        taken[key] = value.gather(steps.ndim, where.expand(*index.shape, *value.shape[steps.ndim + 1 :])).squeeze(
            steps.ndim
        )
    steps = torch.where(steps > spans.shape[-1], 0, steps).unsqueeze(-1)
    seen = taken.pop("observed") & (steps > 0)
    sensor = TensorDict(taken, batch_size=readings.batch_size)
    return readings.select("state").clone().update({"observed": seen, "steps": steps, "sensor": sensor})


def lose_frames(readings: TensorDict, seed: int, share: float = MISSING) -> TensorDict:
    """What the sensor reads where some frames did not arrive: pairs of those that did."""
    kept = torch.rand(len(readings), generator=torch.Generator().manual_seed(seed)) >= share
    return take_spans(readings, steps_between(kept, LONGEST))


def all_frames(readings: TensorDict) -> TensorDict:
    """What the sensor reads of neighbours."""
    return take_spans(readings, torch.ones(len(readings), dtype=torch.int64))


class ReadingSampler:
    """Draws windows of a frozen sensor's readings.

    Args:
        readings: of each part, ``[n]``, with those of all ``LONGEST`` spans.
        weights: shares of the batches.
        length: of the windows.
        gain_error: standard deviation of the logarithm of a factor on all speeds that a window's sensor reads: cameras
            are mounted a little higher or lower, or look a little further up, and the sensor cannot know.
    """

    def __init__(self, readings: Sequence[TensorDict], weights: Sequence[float], length: int, gain_error: float):
        self.readings, self.length, self.gain_error = torch.cat(list(readings)), length, gain_error
        starts, weight, offset = [], [], 0
        for reading, share in zip(readings, weights, strict=True):
            count = len(reading) - length
            if count > 0:  # row 0 has no reading
                starts.append(offset + 1 + torch.arange(count))
                weight.append(torch.full((count,), share / count))
            offset += len(reading)
        if not starts:
            lengths = [len(reading) for reading in readings]
            raise ValueError(
                f"windows of {length} rows do not fit in readings of {lengths} rows; pass a shorter --length"
            )
        self.starts, self.weight = torch.cat(starts), torch.cat(weight)

    def windows(self, generator: torch.Generator, start_std: Tensor, batch: int = 48) -> TensorDict:
        """Windows ``[batch, length]``, faster or slower than they were, of which up to half of the frames are lost."""
        start = self.starts[torch.multinomial(self.weight, batch, replacement=True, generator=generator)]
        windows = self.readings[start.unsqueeze(-1) + torch.arange(self.length)]
        # Few drives have few speeds, and the transition would learn to return to those.
        low, high = torch.tensor([-1.0, -0.7]), torch.tensor([0.7, 0.7])
        speed = (low + (high - low) * torch.rand(batch, 1, 2, generator=generator)).exp()
        gain = (self.gain_error * torch.tensor([1.0, 0.3]) * torch.randn(batch, 1, 2, generator=generator)).exp()
        share = 0.5 * torch.rand(batch, 1, generator=generator)
        kept = torch.rand(batch, self.length + 1, generator=generator) >= share
        windows = take_spans(windows, steps_between(kept, LONGEST)[:, 1:])
        windows["state"][..., VELOCITIES] *= speed
        windows["sensor", "ensemble"] *= (speed * gain).unsqueeze(-2)
        return with_start(windows, start_std, generator)
