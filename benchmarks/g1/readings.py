"""Reads whole episodes by a sensor, with failing cameras; and windows of that.

A sensor stays as it is when filters are trained. Its trunk's features of every frame are computed once, and its
stochastic head runs on those: afterwards a filter costs no pictures.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor
from torch.nn.functional import pad

from benchmarks.g1.aim import HandPlace
from benchmarks.g1.disturbances import BOX, DARK, SHIFT, boxed, shifted
from benchmarks.g1.motion import delayed, with_rates
from benchmarks.g1.recordings import ARM, HAND, JOINTS, targets
from benchmarks.g1.sensors import code_of, read_code
from torch_denkf.data import LeRobotReplay
from torch_denkf.envs import SaltAndPepper
from torch_denkf.modules import ImageSensor
from torch_denkf.monitoring import BlackIsMissing
from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint

PICTURES = ("clean", "salt_and_pepper", "box", "shifted", "dark")  # conditions that change pictures
CONDITIONS = ("clean", "black20", "black20_unannounced", "missing", *PICTURES[1:])
BLACK, MISSING = 20, 0.3  # consecutive black frames; share of frames that do not arrive
GREY = 4 / 255  # noise in black frames
SHARES = (0.5, 0.08, 0.22, 0.12, 0.08)  # of the windows that filters learn from, by PICTURES


def failing(pixels: Tensor, place: Tensor, condition: str, draw: Tensor, exact: bool) -> Tensor:
    """Pictures of a failing camera.

    Args:
        pixels: ``[N, 3, H, W]`` in [0, 1].
        place: of the hand, ``[N, 2]``.
        condition: one of :data:`PICTURES`.
        draw: four numbers in [0, 1) that say how it fails in this episode.
        exact: as in the tests, instead of by the draw: box and light as large as there, a shift of 10 px of 320.
    """
    first, second, third, fourth = draw.tolist()
    if condition == "salt_and_pepper":
        generator = torch.Generator().manual_seed(int(first * 2**31))
        fraction = {} if exact else {"fraction": 0.04 * second}
        return SaltAndPepper(generator=generator, **fraction)(TensorDict({"pixels": pixels}, [len(pixels)]))["pixels"]
    if condition == "box":
        off = torch.tensor([second - 0.5, third - 0.5]) * 0.3
        return boxed(pixels, place) if exact else boxed(pixels, place + off, BOX * (0.7 + 0.8 * first))
    if condition == "shifted":
        reach = SHIFT * pixels.shape[-1] * (1 if exact else 1.4 * first)
        down = round(reach * (second - 0.5)) if not exact else 0
        return shifted(pixels, round(reach if third < 0.5 else -reach), down)
    if condition == "dark":
        return pixels * (DARK if exact else 0.3 + 0.6 * fourth)
    return pixels


@torch.no_grad()
def read_codes(
    sensors: Sequence[ImageSensor],
    data: LeRobotReplay,
    hand: HandPlace | None,
    numbers: Sequence[int],
    *,
    condition: str,
    exact: bool,
    file: Path,
) -> TensorDict:
    """Features of all frames of some episodes ``[N, T]``, the shorter ones filled up; kept in ``file``.

    Where that is there, the place of the hand is not needed.

    ================ ============= ====================================================================================
    ``code``         [N,T,F]       of the sensor's trunk
    ``observed``     [N,T,1]       False where the picture is a repeat or black
    ``valid``        [N,T,1]       False where the episode is over
    ``truth``        [N,T,13]      arm and hand
    ``command``      [N,T,13]      likewise
    ================ ============= ====================================================================================
    """
    if file.exists():
        saved = read_checkpoint(file)
        return TensorDict(saved, batch_size=saved["code"].shape[:2])
    if hand is None:
        raise ValueError(f"there is no {file}; pass the place of the hand, to read the pictures")
    by_number, parts, check = {episode.number: episode for episode in data.episodes}, [], BlackIsMissing()
    longest = max(by_number[number].length for number in numbers)
    for number in numbers:
        episode = by_number[number]
        draw = torch.rand(4, generator=torch.Generator().manual_seed(number))
        codes, observed = [], []
        everything = data.storage[episode.start : episode.start + episode.length]
        for rows in torch.arange(episode.start, episode.start + episode.length).split(64):
            part = data[rows]
            part["pixels"] = failing(part["pixels"], hand(part["state"][:, list(ARM)]), condition, draw, exact)
            codes.append(code_of(sensors, part["pixels"]))
            observed.append(check(part)["seen"])
        command = torch.cat([everything["action"][:, list(ARM)], everything["action"][:, list(HAND)]], -1)
        entries = {
            "code": torch.cat(codes),
            "truth": targets(everything),
            "command": command,
            "observed": torch.cat(observed),
            "valid": torch.ones(episode.length, 1, dtype=torch.bool),
        }
        room = longest - episode.length
        last = ("code", "truth", "command")
        parts.append(
            {
                key: torch.cat([value, value[-1:].expand(room, -1)]) if key in last else pad(value, (0, 0, 0, room))
                for key, value in entries.items()
            }
        )
    codes = {key: torch.stack([part[key] for part in parts]) for key in parts[0]}
    file.parent.mkdir(parents=True, exist_ok=True)
    write_checkpoint(file, codes)
    return TensorDict(codes, batch_size=codes["code"].shape[:2])


def with_readings(
    sensors: Sequence[ImageSensor], codes: TensorDict, members: int, start: Tensor, seed: int = 0
) -> TensorDict:
    """Returns what a filter reads, of features ``[N, T]``: the same random numbers each time.

    ======================= =============== ===========================================================================
    ``sensor``: ensemble    [N,T,E,D]       samples of the sensor
    ``sensor``: encoding    [N,T,F]         of its head
    ``state``               [N,T,D]         the truth
    ``motion``              [N,T,2D]        with rates
    ``action``              [N,T,2D]        commands, see :func:`benchmarks.g1.motion.delayed`
    ``arrived``             [N,T,1]         False where there is no picture, not even a repeat
    ``start``               [N,T,D]         where episodes begin on average
    ======================= =============== ===========================================================================
    """
    generator = torch.Generator().manual_seed(seed)
    ensembles, encodings = [], []
    for part in codes["code"].split(1):
        with torch.no_grad():
            samples, encoding = read_code(sensors, part, members, generator)
        ensembles.append(samples[..., :JOINTS].clone())
        encodings.append(encoding)
    out = codes.select("observed", "valid")
    out["arrived"] = out["valid"].clone()
    truth, command = codes["truth"][..., :JOINTS], codes["command"][..., :JOINTS]
    out["sensor"] = TensorDict(
        {"ensemble": torch.cat(ensembles), "encoding": torch.cat(encodings)}, batch_size=out.batch_size
    )
    out["state"], out["start"] = truth, start.expand_as(truth)
    out["motion"] = torch.stack([with_rates(one) for one in truth])
    out["action"] = torch.stack([delayed(one) for one in command])
    return out


def standardised(encoding: Tensor, loc: Tensor, scale: Tensor) -> Tensor:
    """An encoding ``[*, F]`` with mean zero and variance one where ``loc`` and ``scale`` were taken, within 5."""
    return ((encoding - loc) / scale).clamp(-5, 5)


@torch.no_grad()
def black_readings(sensors: Sequence[ImageSensor], members: int) -> TensorDict:
    """Returns the reading of a black picture, and whether such a picture counts as observed, ``[1, 1]``."""
    generator = torch.Generator().manual_seed(1)
    pixels = GREY * torch.rand(1, *sensors[0].image_shape, generator=generator)
    samples, encoding = read_code(sensors, code_of(sensors, pixels).unsqueeze(0), members, generator)
    entries = {"ensemble": samples[..., :JOINTS], "encoding": encoding}
    observed = BlackIsMissing()(TensorDict({"pixels": pixels}, [1]))["seen"]
    return TensorDict({**entries, "observed": observed.unsqueeze(0)}, batch_size=[1, 1])


def blackouts(lengths: Tensor, seed: int = 0) -> Tensor:
    """Draws where the black frames begin, ``[N]``: in the middle half of each episode."""
    share = torch.rand(len(lengths), generator=torch.Generator().manual_seed(seed))
    return (lengths * (0.25 + 0.5 * share)).long()


def fail(readings: TensorDict, condition: str, black: TensorDict, seed: int = 0) -> TensorDict:
    """A copy of clean readings ``[N, T]`` whose camera fails: frames do not arrive, or are black."""
    count, steps = readings.shape
    if condition == "missing":
        lost = torch.rand(count, steps, 1, generator=torch.Generator().manual_seed(seed)) < MISSING
        return without(readings, lost)
    begin = blackouts(readings["valid"].sum((1, 2)), seed).unsqueeze(-1)
    step = torch.arange(steps)
    dark = ((step >= begin) & (step < begin + BLACK)).unsqueeze(-1)
    if condition == "black20":
        return without(readings, dark)
    return with_black(readings, dark, black)


def without(readings: TensorDict, lost: Tensor) -> TensorDict:
    """Readings ``[N, T]`` without the frames that are ``lost`` ``[N, T, 1]``, of which nothing is left."""
    out = readings.copy()
    for key in ("observed", "arrived"):
        out[key] = out[key] & ~lost
    sensor = readings["sensor"].copy()
    sensor["ensemble"] = torch.where(lost.unsqueeze(-1), 0.0, sensor["ensemble"])
    sensor["encoding"] = torch.where(lost, 0.0, sensor["encoding"])
    return out.set("sensor", sensor)


def with_black(readings: TensorDict, dark: Tensor, black: TensorDict) -> TensorDict:
    """Readings ``[N, T]`` with those of black frames where ``dark`` ``[N, T, 1]``; nothing but the picture says so.

    Each black frame counts as a picture of its own. (Who masks repeats would mask all but the first: that is easier.)
    Where black pictures are recognised, nothing is left of them.
    """
    sensor = TensorDict(
        {
            "ensemble": torch.where(dark.unsqueeze(-1), black["ensemble"], readings["sensor", "ensemble"]),
            "encoding": torch.where(dark, black["encoding"], readings["sensor", "encoding"]),
        },
        batch_size=readings.batch_size,
    )
    out = readings.copy()
    out["sensor"] = sensor
    out["observed"] = out["observed"] | (dark & out["valid"])
    return without(out, dark & ~black["observed"])


class Windows:
    """Draws windows of readings, with failing cameras, that begin near what the sensor says.

    Args:
        readings: of the tuning episodes ``[N, T]``, by condition.
        black: of a black frame.
        length: of the windows.
    """

    def __init__(self, readings: dict[str, TensorDict], black: TensorDict, length: int):
        self.all = torch.stack([readings[name] for name in PICTURES])
        self.black, self.length = black, length
        self.lengths = readings["clean"]["valid"].sum((1, 2))
        if length > int(self.lengths.min()):
            raise ValueError(f"windows of {length} rows do not fit in an episode of {int(self.lengths.min())}")

    def sample(self, generator: torch.Generator, batch: int, error: Tensor, padding: int) -> TensorDict:
        """Windows ``[batch, length]``.

        Half show clean pictures, see ``SHARES``. In half of all up to half of the frames are missing; in a sixth each a
        stretch is missing, or black without a word.

        Args:
            generator: of all random numbers.
            batch: how many.
            error: how far they begin from what the sensor says, ``[D]``.
            padding: numbers of the filters' state beyond place and rates.
        """
        length = self.length

        def draw(*shape: int) -> Tensor:
            return torch.rand(batch, *shape, generator=generator)

        episode = torch.randint(self.all.shape[1], (batch,), generator=generator)
        which = torch.multinomial(torch.tensor(SHARES), batch, replacement=True, generator=generator)
        first = (draw() * (self.lengths[episode] - length + 1)).long()
        rows = first.unsqueeze(-1) + torch.arange(length)
        windows = self.all[which.unsqueeze(-1), episode.unsqueeze(-1), rows]
        # The start must say less than the sensor, or a filter learns to hold on to it, which fails in whole episodes.
        start = windows["sensor", "ensemble"][:, 0].mean(-2)
        start = start + error * torch.randn(start.shape, generator=generator)
        lost = draw(length, 1) < draw(1, 1) - 0.5
        begin = 1 + (draw(1) * (length - 1)).long()
        kind, step = draw(1, 1), torch.arange(length)
        stretch = ((step >= begin) & (step < begin + (draw(1) * (BLACK + 1)).long())).unsqueeze(-1)
        windows = without(windows, lost | (stretch & (kind < 0.17)))
        windows = with_black(windows, stretch & (kind > 0.83), self.black)
        windows["padded"] = pad(windows["motion"], (0, padding))
        windows["start"] = start.unsqueeze(1).expand_as(windows["state"])
        return windows
