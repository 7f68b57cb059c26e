"""A training step of the README's KITTI filter with Table I's image sensor, compared with its image trunk alone.

64 sequences of 20 frames, 150x50x6, in single precision: filter, fair CRPS, backward, clipping, AdamW. The trunk's own
forward and backward run in the same rounds and on the same frames, once on all 1,280 frames in one call
(``trunk(frames)``), and once in the sensor's chunks.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict

from benchmarks.speed.pairs import Row, in_turn
from benchmarks.speed.workload import car_filter
from torch_denkf.filters import DEnKF
from torch_denkf.modules import ImageSensor
from torch_denkf.objectives import DEnKFLoss

BATCH, STEPS, IMAGE = 64, 20, (6, 50, 150)
EVERYTHING = 2**40  # bytes: a budget that holds all frames
ALONE = {"trunk alone, all frames in one call": False, "trunk alone, chunks": True}


def make_filter(**options) -> DEnKF:
    """Returns the README's filter of a vehicle."""
    torch.manual_seed(0)
    return car_filter(lambda: ImageSensor(observation_dim=2, image_shape=IMAGE, **options))


def make_batch(batch: int = BATCH, steps: int = STEPS) -> TensorDict:
    """Returns random frames in the shapes of a batch, as times do not depend on the contents."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(batch, steps, *IMAGE, generator=generator) - 0.5
    return TensorDict({"pixels": pixels, "state": torch.randn(batch, steps, 5, generator=generator)}, [batch, steps])


def training_step(denkf: DEnKF, batch: TensorDict):
    """Returns a function without arguments that runs one update."""
    loss, optimiser = DEnKFLoss(denkf), torch.optim.AdamW(denkf.parameters(), lr=1e-4)

    def step() -> None:
        optimiser.zero_grad()
        sum(loss(batch).values()).backward()
        torch.nn.utils.clip_grad_norm_(denkf.parameters(), 1.0)
        optimiser.step()

    return step


def trunk_alone(denkf: DEnKF, batch: TensorDict, *, chunked: bool):
    """Returns a call of the trunk's forward and backward on all frames, optionally in the sensor's chunks."""
    sensor, frames = denkf["sensor"], batch["pixels"].flatten(0, 1)
    trunk = sensor.module["trunk"]

    def step() -> None:
        trunk.zero_grad()
        features = sensor._features(frames, None) if chunked else trunk(frames)
        features.sum().backward()

    return step


def rows(seconds: float, rounds: int = 7, batch: int = BATCH, steps: int = STEPS) -> list[Row]:
    """Returns rows of a training step against the trunk's forward and backward; ``seconds`` does not limit them."""
    data, filter = make_batch(batch, steps), make_filter()
    calls = {"step": training_step(filter, data)}
    calls |= {name: trunk_alone(filter, data, chunked=chunked) for name, chunked in ALONE.items()}
    timings = in_turn(calls, rounds)
    note = f"B={batch}, T={steps}, 150x50x6; forward, CRPS, backward, clipping, AdamW; a whole step"
    name = "training step, KITTI preset / "
    return [timings.row(name + other, "step", other, target=1.15, note=note) for other in ALONE]
