"""Reads whole sequences by a camera sensor, with camera faults, and draws windows of them to train filters on.

A sensor's trunk is frozen when filters are trained. Its features of every frame are computed once, and its stochastic
head runs on those, so that training a filter, of any ensemble size, processes no images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.data.replay import EpisodeReplay
from torch_denkf.modules import ImageSensor
from torch_denkf.monitoring import BlackIsMissing
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

BLACK, MISSING = 20, 0.3  # consecutive black frames; share of frames that do not arrive


def code_of(sensors: Sequence[ImageSensor], pixels: Tensor) -> Tensor:
    """Returns concatenated features of the sensors' trunks ``[N, F]`` of images ``[N, 3, H, W]``."""
    return torch.cat([sensor._features(pixels, None) for sensor in sensors], -1)


@torch.no_grad()
def read_codes(
    sensors: Sequence[ImageSensor],
    data: EpisodeReplay,
    sequences: Iterable[Tensor],
    see: Callable[[TensorDict], TensorDict],
    file: Path,
) -> TensorDict:
    """Returns features of all frames of some sequences ``[N, T]``, padded to one length, and caches them in a file.

    Args:
        sensors: whose trunks run.
        data: the recordings.
        sequences: rows of each.
        see: maps rows ``[n]`` of the data to ``"pixels"``, maybe with a camera fault, and other entries to keep.
        file: with ``"code"`` ``[N, T, F]``, these entries, and ``[N, T, 1]`` each: ``"observed"``, whether an image is
            new and not black, ``"arrived"``, whether one came, and ``"valid"``, whether the sequence continues.
    """
    if not file.exists():
        check, parts = BlackIsMissing(), []
        for rows in sequences:
            frames = [check(see(data[some])) for some in rows.split(64)]
            codes = [part.exclude("pixels").set("code", code_of(sensors, part["pixels"])) for part in frames]
            part = torch.cat(codes).rename_key_("seen", "observed")
            parts.append(part.set("valid", torch.ones_like(part["observed"])))
        longest = max(map(len, parts))
        for number, part in enumerate(parts):  # pad by repeating the last row
            filled = part[torch.arange(longest).clamp(max=len(part) - 1)]
            over = torch.arange(longest).unsqueeze(-1) >= len(part)
            masks = {key: filled[key] & ~over for key in ("observed", "valid")}
            parts[number] = filled.update(masks).set("arrived", masks["valid"].clone())
        write_checkpoint(file, torch.stack(parts).contiguous().to_dict())
    saved = read_checkpoint(file)
    return TensorDict(saved, batch_size=saved["code"].shape[:2])


def read_heads(
    sensors: Sequence[ImageSensor], code: Tensor, size: int, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Returns samples ``[*B, size, O]`` and encoding ``[*B, F]`` of the sensors' heads, from features ``[*B, F]``.

    The samples are split among the sensors, which were trained from different seeds, so that their spread includes the
    uncertainty of training.
    """
    parts, hidden = [], []
    for k, (sensor, own) in enumerate(zip(sensors, code.chunk(len(sensors), -1), strict=True)):
        head, count = sensor.module["head"], size // len(sensors) + (k < size % len(sensors))
        noise = head.draw_noise(own.shape[:-1], count, dtype=own.dtype, generator=generator)
        samples, seen = head(own.unsqueeze(-2), noise, with_hidden=True)
        parts.append((sensor.loc + sensor.scale * samples).expand(*own.shape[:-1], count, -1))
        hidden.append(seen.mean(-2))
    return torch.cat(parts, -2), torch.cat(hidden, -1)


def with_head(
    sensors: Sequence[ImageSensor], codes: TensorDict, size: int, generator: torch.Generator | None = None
) -> TensorDict:
    """Returns the entries with ``("sensor", "ensemble")`` and ``("sensor", "encoding")`` instead of features."""
    samples, encoding = read_heads(sensors, codes["code"], size, generator)
    out = codes.exclude("code")
    out["sensor"] = TensorDict({"ensemble": samples, "encoding": encoding}, batch_size=out.batch_size)
    return out


@torch.no_grad()
def read_all(sensors: Sequence[ImageSensor], codes: TensorDict, size: int, seed: int = 0) -> TensorDict:
    """Runs the heads on all sequences, one at a time, with the same seed in each call."""
    generator = torch.Generator().manual_seed(seed)
    return torch.cat([with_head(sensors, part, size, generator) for part in codes.split(1)])


def blackouts(lengths: Tensor, seed: int = 0) -> Tensor:
    """Draws the first black frame of each sequence ``[N]``, in its middle half."""
    share = torch.rand(len(lengths), generator=torch.Generator().manual_seed(seed))
    return (lengths * (0.25 + 0.5 * share)).long()


def fail(readings: TensorDict, condition: str, seed: int = 0) -> TensorDict:
    """Returns readings ``[N, T]`` under a camera fault, ``"black20"`` or ``"missing"``; otherwise unchanged."""
    count, steps = readings.shape
    if condition == "missing":
        return without(readings, torch.rand(count, steps, 1, generator=torch.Generator().manual_seed(seed)) < MISSING)
    if condition == "black20":
        begin, step = blackouts(readings["valid"].sum((1, 2)), seed).unsqueeze(-1), torch.arange(steps)
        return without(readings, ((step >= begin) & (step < begin + BLACK)).unsqueeze(-1))
    return readings


def without(readings: TensorDict, lost: Tensor) -> TensorDict:
    """Returns readings ``[N, T]`` without the frames that are ``lost`` ``[N, T, 1]``: masked and set to zero."""
    out = readings.copy()
    for key in ("observed", "arrived"):
        out[key] = out[key] & ~lost
    if "sensor" in out:
        sensor = readings["sensor"].copy()
        sensor["ensemble"] = torch.where(lost.unsqueeze(-1), 0.0, sensor["ensemble"])
        sensor["encoding"] = torch.where(lost, 0.0, sensor["encoding"])
        out["sensor"] = sensor
    return out


class Windows:
    """Draws windows of readings or of features, with camera faults.

    Args:
        readings: of conditions, ``[N, T]`` each.
        length: of the windows.
        shares: of the windows, by condition; by default, all sequences have the same probability.
    """

    def __init__(self, readings: Sequence[TensorDict], length: int, shares: Sequence[float] | None = None):
        self.all, self.length = torch.cat(list(readings)), length
        self.lengths = self.all["valid"].sum((1, 2))
        if length > int(self.lengths.min()):
            raise ValueError(f"windows of {length} rows do not fit in a sequence of {int(self.lengths.min())}")
        counts = torch.tensor([len(one) for one in readings])
        shares = counts if shares is None else torch.tensor(shares)
        self.weights = (shares / counts).repeat_interleave(counts)

    def sample(self, generator: torch.Generator, batch: int, length: int | None = None) -> TensorDict:
        """Returns windows ``[batch, length]``; half of them have missing frames, a third a gap."""
        length = length or self.length

        def draw(*shape: int) -> Tensor:
            return torch.rand(batch, *shape, generator=generator)

        which = torch.multinomial(self.weights, batch, replacement=True, generator=generator)
        first = (draw() * (self.lengths[which] - length + 1)).long()
        windows = self.all[which.unsqueeze(-1), first.unsqueeze(-1) + torch.arange(length)]
        lost = draw(length, 1) < draw(1, 1) - 0.5
        lost[:, 0] = False  # the window's initial belief needs it
        begin, step = 1 + (draw(1) * (length - 1)).long(), torch.arange(length)
        end = begin + (draw(1) * (BLACK + 1)).long() * (draw(1) < 0.33)
        return without(windows, lost | ((step >= begin) & (step < end)).unsqueeze(-1))
