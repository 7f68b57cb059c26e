"""Reads whole sequences by a sensor, with failing cameras; and windows of that.

A sensor's trunk is frozen when filters are trained. Its features of every frame are computed once, and its stochastic
head runs on those: afterwards a filter, of any ensemble size, costs no pictures.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.ur5.demos import STATE
from benchmarks.ur5.motion import with_rates
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.deployment.files import write_bytes
from torch_denkf.envs import SaltAndPepper
from torch_denkf.modules import ImageSensor
from torch_denkf.monitoring import BlackIsMissing

CONDITIONS = ("clean", "black20", "missing", "salt_and_pepper")
BLACK, MISSING = 20, 0.3  # consecutive black frames; share of frames that do not arrive


@torch.no_grad()
def read_codes(
    sensor: ImageSensor, data: UR5ExperienceReplay, demos: Sequence[int], *, condition: str, file: Path
) -> TensorDict:
    """Features of all frames of some demos ``[N, T]``; kept in ``file``.

    ================ ============= ====================================================================================
    ``code``         [N,T,F]       of the sensor's trunk
    ``observed``     [N,T,1]       False where the frame is black
    ``state``        [N,T,10]      the truth
    ``motion``       [N,T,24]      with rates and accelerations, see :func:`with_rates`
    ================ ============= ====================================================================================
    """
    if file.exists():
        return TensorDict(torch.load(file, weights_only=True), batch_size=[len(demos)]).auto_batch_size_(2)
    by_number = {episode.demo: episode for episode in data.episodes}
    check, sensor = BlackIsMissing(observed_key="arrived", out_key="observed"), sensor.eval()
    sequences = []
    for number in demos:
        episode = by_number[number]
        parts = []
        for rows in torch.arange(episode.start, episode.start + episode.length).split(64):
            part = data[rows].select("pixels", "state")
            if condition == "salt_and_pepper":
                part = SaltAndPepper(generator=torch.Generator().manual_seed(int(rows[0])))(part)
            part = check(part)
            pictures = sensor._prepare(part.pop("pixels"))
            parts.append(part.set("code", sensor.module["trunk"](pictures)))
        sequences.append(torch.cat(parts))
    codes = torch.stack(sequences)
    codes["motion"] = with_rates(codes["state"])
    memory = io.BytesIO()
    torch.save(codes.to_dict(), memory)
    write_bytes(file, memory.getbuffer())
    return codes


def read_head(
    sensor: ImageSensor, codes: TensorDict, size: int, generator: torch.Generator | None = None
) -> TensorDict:
    """A copy with ``("sensor", "ensemble")`` ``[*B, E, O]`` and ``("sensor", "encoding")`` of the sensor's head."""
    head, code = sensor.module["head"], codes["code"]
    noise = head.draw_noise(code.shape[:-1], size, dtype=code.dtype, generator=generator)
    samples, hidden = head(code.unsqueeze(-2), noise, with_hidden=True)
    samples = (sensor.loc + sensor.scale * samples).expand(*code.shape[:-1], size, -1)
    out = codes.exclude("code")
    out["sensor"] = TensorDict({"ensemble": samples, "encoding": hidden.mean(-2)}, batch_size=out.batch_size)
    return out


@torch.no_grad()
def read_all(sensor: ImageSensor, codes: TensorDict, size: int, seed: int = 0) -> TensorDict:
    """Reads whole collections, a demo at a time, from the same random numbers each time."""
    generator = torch.Generator().manual_seed(seed)
    return torch.cat([read_head(sensor, part, size, generator) for part in codes.split(1)])


def fail(readings: TensorDict, condition: str, seed: int = 0) -> TensorDict:
    """A copy whose camera fails: frames are missing, or black, at random places of each demo; never the first one."""
    count, steps = readings.shape
    generator, out = torch.Generator().manual_seed(seed), readings.copy()
    seen = readings["observed"].clone()
    if condition == "missing":
        seen &= torch.rand(count, steps, 1, generator=generator) >= MISSING
    if condition == "black20":
        begin = blackouts(count, steps, seed)
        step = torch.arange(steps)
        seen &= ~((step >= begin.unsqueeze(-1)) & (step < begin.unsqueeze(-1) + BLACK)).unsqueeze(-1)
    seen[:, 0] = readings["observed"][:, 0]
    return out.set("observed", seen)


def with_missing(readings: TensorDict) -> TensorDict:
    """Clean demos, and the same with missing frames: what filters are validated on."""
    return torch.cat([readings, fail(readings, "missing", seed=1)])


def blackouts(count: int, steps: int, seed: int = 0) -> Tensor:
    """Draws where the black frames begin, ``[count]``: some time after the start, and some before the end."""
    margin = min(BLACK, max((steps - BLACK) // 3, 1))
    low, high = margin, max(steps - BLACK - margin, margin + 1)
    return torch.randint(low, high, (count,), generator=torch.Generator().manual_seed(seed))


class Windows:
    """Draws windows of readings, with failing cameras, that begin from a wrong state.

    Args:
        codes: of demos ``[N, T]``, clean; and the same or others otherwise disturbed.
        length: of the windows.
        start_std: how wrong they begin, ``[24]``.
    """

    def __init__(self, codes: Sequence[TensorDict], length: int, start_std: Tensor):
        self.codes, self.length, self.start_std = torch.cat(list(codes)), length, start_std
        if length > self.codes.shape[1]:
            raise ValueError(f"windows of {length} rows do not fit in demos of {self.codes.shape[1]}; pass less")

    def sample(self, generator: torch.Generator, batch: int, length: int | None = None) -> TensorDict:
        """Windows ``[batch, length]``: in half of them up to half of the frames are missing, in a third a stretch."""
        length = self.length if length is None else length
        count, steps = self.codes.shape
        demo = torch.randint(count, (batch, 1), generator=generator)
        first = torch.randint(steps - length + 1, (batch, 1), generator=generator)
        windows = self.codes[demo, first + torch.arange(length)]
        share = torch.rand(batch, 1, 1, generator=generator) - 0.5
        lost = torch.rand(batch, length, 1, generator=generator) < share
        begin = torch.randint(1, length, (batch, 1), generator=generator)
        end = begin + torch.randint(BLACK + 1, (batch, 1), generator=generator)
        end = torch.where(torch.rand(batch, 1, generator=generator) < 0.33, end, begin)
        step = torch.arange(length)
        black = ((step >= begin) & (step < end)).unsqueeze(-1)
        windows["observed"] = windows["observed"] & ~lost & ~black
        unknown = torch.zeros(batch, length, STATE)  # the sensor's slow errors, which do not count
        windows["motion_and_bias"] = torch.cat([windows["motion"], unknown], -1)
        noise = torch.randn(batch, 1, len(self.start_std), generator=generator)
        windows["start"] = windows["motion"] + self.start_std * noise
        return windows
