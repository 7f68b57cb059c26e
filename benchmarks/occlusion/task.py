"""A ball in a box, behind a pillar: its motion, its pictures, a small camera, and the filters."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.baselines import LSTMFilter
from torch_denkf.filters import EKF, DEnKF, Filter, ParticleFilter
from torch_denkf.imperfect import FadingBias, Visibility
from torch_denkf.modules import (
    AroundState,
    DiagonalNoise,
    EnsembleAnalysis,
    GaussianAround,
    ImageSensor,
    LearnedTransition,
    Select,
    SubModel,
)

__all__ = ["KINDS", "RATE", "camera", "drawn", "filter_of", "read", "runs"]

WIDTH, HEIGHT, RADIUS = 64, 48, 3.0  # pixels
PILLAR = (24, 40)  # columns
RATE = 10  # pictures a second
PUSH = 0.02  # standard deviation of what a step adds to each component of the speed, in pixels a step
NEAR, TURN = 2.0, 0.7  # so many pixels from a wall a filter does not know whether the ball has bounced: pixels a step
#: Of place and speed, pixels and pixels a step; and how well a filter knows where a run starts.
MEAN, STD, START = [WIDTH / 2, HEIGHT / 2, 0.0, 0.0], [16.0, 12.0, 1.2, 1.2], [2.0, 2.0, 0.5, 0.5]
ENCODING, READING = 32, 1.0  # features of the camera; pixels, of a reading's noise before training
MEMBERS = {"DEnKF": 32, "particle filter": 200}
KINDS = ("DEnKF", "EKF", "particle filter", "LSTM")


class Bounce(nn.Module):
    """A step of a ball between four walls."""

    def forward(self, state: Tensor) -> Tensor:
        """The states ``[*, 4]`` one step later."""
        place, speed = state[..., :2] + state[..., 2:], state[..., 2:]
        for wall, sign in ((place.new_tensor([RADIUS, RADIUS]), 1), (place.new_tensor([WIDTH, HEIGHT]) - RADIUS, -1)):
            behind = sign * (place - wall) < 0
            place, speed = torch.where(behind, 2 * wall - place, place), torch.where(behind, -speed, speed)
        return torch.cat([place, speed], -1)


class WallNoise(SubModel):
    """The noise of the motion: a push, and near a wall the doubt whether the ball has bounced."""

    def __init__(self):
        super().__init__(nn.Identity(), [("belief", "mean"), ("forecast", "mean")], [("forecast", "noise")])

    def compute(self, _, mean):
        """Variances ``[*B, 4]``."""
        place = mean[..., :2]
        wall = torch.maximum(RADIUS - place, place - (place.new_tensor([WIDTH, HEIGHT]) - RADIUS)) > -NEAR
        speed = PUSH**2 + wall * TURN**2
        return torch.cat([torch.zeros_like(speed), speed], -1)


def runs(count: int, steps: int, seed: int) -> TensorDict:
    """True states ``[count, steps, 4]``; and how much of the ball is seen: ``visible`` ``[count, steps, 1]``.

    It is 1 or 0, and NaN where a part of the ball is behind the pillar.
    """
    generator = torch.Generator().manual_seed(seed)
    place = RADIUS + torch.rand(count, 2, generator=generator) * (torch.tensor([WIDTH, HEIGHT]) - 2 * RADIUS)
    slope = torch.pi / 4 * (2 * torch.rand(count, 1, generator=generator) - 1)
    side = torch.randint(2, (count, 1), generator=generator) * 2 - 1
    way = torch.cat([side * slope.cos(), slope.sin()], -1)
    speed = (0.7 + 0.9 * torch.rand(count, 1, generator=generator)) * way
    state, states, bounce = torch.cat([place, speed], -1), [], Bounce()
    for _ in range(steps):
        states.append(state)
        push = PUSH * torch.randn(count, 2, generator=generator)
        state = bounce(state) + nn.functional.pad(push, (2, 0))
    data = TensorDict({"state": torch.stack(states, 1)}, [count, steps])
    x, (left, right) = data["state"][..., :1], PILLAR
    hidden, seen = (x - RADIUS >= left) & (x + RADIUS <= right), (x + RADIUS <= left) | (x - RADIUS >= right)
    data["visible"] = torch.where(seen, 1.0, torch.where(hidden, 0.0, torch.nan))
    return data


def drawn(states: Tensor, seed: int) -> Tensor:
    """Pictures ``[*B, 1, 48, 64]``, uint8, of states ``[*B, 4]``: a bright ball, a grey pillar in front, noise."""
    noise, pictures = np.random.default_rng(seed), []
    for x, y in states[..., :2].reshape(-1, 2).tolist():
        picture = np.full((HEIGHT, WIDTH), 60, np.uint8)
        cv2.circle(picture, (round(16 * x), round(16 * y)), round(16 * RADIUS), 220, -1, cv2.LINE_AA, shift=4)
        picture[:, PILLAR[0] : PILLAR[1]] = 120
        picture = picture + noise.normal(0, 10, picture.shape)
        pictures.append(picture.clip(0, 255).astype(np.uint8))
    return torch.from_numpy(np.stack(pictures)).reshape(*states.shape[:-1], 1, HEIGHT, WIDTH)


def camera() -> ImageSensor:
    """A network that reads a place from a picture."""
    sizes, trunk = (1, 8, 16, 16), []
    for before, after in pairwise(sizes):
        trunk += [nn.Conv2d(before, after, 5 if before == 1 else 3, 2, 2 if before == 1 else 1), nn.ReLU()]
    trunk = nn.Sequential(*trunk, nn.Flatten(), nn.Linear(16 * 6 * 8, 64), nn.ReLU())
    return ImageSensor(
        2,
        image_shape=(1, HEIGHT, WIDTH),
        ensemble_size=1,
        trunk=trunk,
        num_cells=(ENCODING,),
        layer="none",
        loc=MEAN[:2],
        scale=STD[:2],
        encoding_key=("sensor", "encoding"),
    )


@torch.no_grad()
def read(sensor: ImageSensor, data: TensorDict, seed: int) -> TensorDict:
    """The runs with what the camera reads: ``reading`` ``[*B, 2]`` and ``encoding``."""
    out = data.copy()
    rows = []
    for number in range(len(data)):
        frames = TensorDict({"pixels": drawn(data["state"][number], seed + number)}, data.batch_size[1:])
        rows.append(sensor(frames))
    out["reading"] = torch.stack([row["sensor", "ensemble"].squeeze(-2) for row in rows])
    out["encoding"] = torch.stack([row["sensor", "encoding"] for row in rows])
    return out


def filter_of(kind: str, *, visibility: bool = False, error: FadingBias | None = None) -> Filter:
    """A filter of the camera's readings; it knows the motion, and learns how far it can trust a reading."""
    if kind == "LSTM":
        return LSTMFilter(
            None,
            features=ENCODING,
            state_dim=4,
            loc=MEAN,
            scale=STD,
            hidden_size=64,
            observation_dim=2,
            encoding_key="encoding",
            observation_key="reading",
            observation_loc=MEAN[:2],
            observation_scale=STD[:2],
        )
    noise = DiagonalNoise(2, r=READING, in_features=ENCODING, in_key="encoding")
    head = Visibility(ENCODING, encoding_key="encoding") if visibility else None
    parts = LearnedTransition(Bounce(), residual=False), None, Select([0, 1])
    options = {"process_noise": WallNoise(), "visibility": head}
    if kind == "EKF":
        return EKF(
            *parts, noise, initial=GaussianAround(START), observation_key="reading", sensor_error=error, **options
        )
    initial = AroundState(START, ensemble_size=MEMBERS[kind])
    if kind == "particle filter":
        # Pushes alone leave too few different particles.
        options |= {"observation_key": "reading", "jitter": 0.5}
        return ParticleFilter(*parts, noise=noise, initial=initial, **options)
    analysis = EnsembleAnalysis("etkf", observation_key="reading")
    return DEnKF(*parts, noise, analysis, initial=initial, sensor_error=error, **options)
