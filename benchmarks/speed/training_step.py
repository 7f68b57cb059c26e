"""A training step of the README's KITTI filter with Table I's image sensor: what it costs beyond the image trunk.

    python -m benchmarks.speed.training_step --out benchmarks/speed/results/training_step.md

64 sequences of 20 frames, 150x50x6, in single precision: filter, fair CRPS, backward, clipping, AdamW. Beside it, in
the same rounds and on the same frames, the trunk's own forward and backward, once on all 1,280 frames in one call, as
``trunk(frames)`` does it, and once in the sensor's chunks. Processor time of one thread; memory is the resident peak of
a child process for each option.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.speed.machine import resident_peak
from benchmarks.speed.pairs import Row, Timings, in_turn
from benchmarks.speed.workload import car_filter
from torch_denkf.filters import DEnKF
from torch_denkf.modules import ImageSensor
from torch_denkf.objectives import DEnKFLoss

BATCH, STEPS, IMAGE = 64, 20, (6, 50, 150)
EVERYTHING = 2**40  # bytes: a budget that holds all frames
OPTIONS = {
    "all frames in one call": {"trunk_memory": EVERYTHING},
    "chunks of 32 MiB (default on a CPU)": {},
    "chunks, recompute": {"recompute": True},
    "chunks, bfloat16": {"trunk_dtype": torch.bfloat16},
    "chunks, recompute, bfloat16": {"recompute": True, "trunk_dtype": torch.bfloat16},
}
DEFAULT = "chunks of 32 MiB (default on a CPU)"
ALONE = ("trunk alone, all frames in one call", "trunk alone, chunks")


def make_filter(**options) -> DEnKF:
    """The README's filter of a vehicle."""
    torch.manual_seed(0)
    return car_filter(lambda: ImageSensor(observation_dim=2, image_shape=IMAGE, **options))


def make_batch(batch: int = BATCH, steps: int = STEPS) -> TensorDict:
    """Noise in the shapes of a batch; what it shows does not matter to the clock."""
    generator = torch.Generator().manual_seed(0)
    pixels = torch.rand(batch, steps, *IMAGE, generator=generator) - 0.5
    return TensorDict({"pixels": pixels, "state": torch.randn(batch, steps, 5, generator=generator)}, [batch, steps])


def training_step(denkf: DEnKF, batch: TensorDict):
    """One update, as a function without arguments."""
    loss, optimiser = DEnKFLoss(denkf), torch.optim.AdamW(denkf.parameters(), lr=1e-4)

    def step() -> None:
        optimiser.zero_grad()
        sum(loss(batch).values()).backward()
        torch.nn.utils.clip_grad_norm_(denkf.parameters(), 1.0)
        optimiser.step()

    return step


def trunk_alone(denkf: DEnKF, batch: TensorDict, *, chunked: bool):
    """The trunk's forward and backward on all frames; chunked: by the sensor's own hand."""
    sensor, frames = denkf["sensor"], batch["pixels"].flatten(0, 1)
    trunk = sensor.module["trunk"]

    def step() -> None:
        trunk.zero_grad()
        features = sensor._features(frames, None) if chunked else trunk(frames)
        features.sum().backward()

    return step


def measure(rounds: int = 7, batch: int = BATCH, steps: int = STEPS) -> Timings:
    """Each option, and the trunk alone in both ways."""
    torch.set_num_threads(1)
    data, filters = make_batch(batch, steps), {name: make_filter(**options) for name, options in OPTIONS.items()}
    calls = {name: training_step(denkf, data) for name, denkf in filters.items()}
    for name, chunked in zip(ALONE, (False, True), strict=True):
        calls[name] = trunk_alone(filters[DEFAULT], data, chunked=chunked)
    return in_turn(calls, rounds)


def rows_of(timings: Timings) -> list[Row]:
    """A training step over the trunk's own forward and backward."""
    note = f"B={BATCH}, T={STEPS}, 150x50x6; forward, CRPS, backward, clipping, AdamW; a whole step"
    name = "training step, KITTI preset / "
    return [timings.row(name + other, DEFAULT, other, target=1.15, note=note) for other in ALONE]


def rows(seconds: float) -> list[Row]:
    """The same for ``make bench``, which takes as long as it takes."""
    return rows_of(measure())


PREPARE = """
from benchmarks.speed import training_step as bench
denkf, batch = bench.make_filter(**bench.OPTIONS[{name!r}]), bench.make_batch({batch}, {steps})
bench.training_step(bench.make_filter(), bench.make_batch(1, 2))()
"""
ACT = """
step = bench.training_step(denkf, batch)
step(), step()
"""


def resident_mib(name: str, batch: int, steps: int) -> float:
    """Returns what a training step takes beyond model and batch, in MiB, in a process of its own."""
    return resident_peak(PREPARE.format(name=name, batch=batch, steps=steps), ACT) / 2**20


def table(timings: Timings, memory: dict[str, float], command: str, elapsed: float) -> str:
    """The Markdown page."""
    lines = [
        "# A training step of the KITTI preset",
        "",
        f"B = {BATCH}, T = {STEPS}, frames of 150x50x6, E = 32; one thread, processor time, medians over rounds.",
        "Memory: resident peak of a child process beyond model and batch (the batch itself is 220 MiB).",
        "",
        *head("training step", "s", "over the trunk alone, one call", "over the trunk alone, chunks", "memory, MiB"),
    ]
    taken = {name: f"{1e-6 * timings.micro(name):.2f}" for name in timings.rounds}
    for name in OPTIONS:
        cells = [f"{timings.ratio(name, other):.2f}" for other in ALONE]
        lines.append(line(name, taken[name], *cells, f"{memory[name]:,.0f}"))
    lines += [line(name, taken[name], "", "", "") for name in ALONE]
    lines += ["", *head("what", "ratio", "target", "met")]
    lines += [line(row.name, f"{row.ratio:.2f}", row.target, row.met_text) for row in rows_of(timings)]
    lines += [
        "",
        "In one call the results of the first layer alone are 600 MB, in fresh pages at every step; chunks of",
        "`ImageSensor(trunk_memory=...)` reuse theirs. `recompute=True` keeps frames and features alone for the",
        "backward pass. bfloat16 (`trunk_dtype`) is fast where the processor has instructions for it.",
        "",
        f"`{command}`: {elapsed:.0f} s; torch {torch.__version__}.",
    ]
    return "\n".join(lines) + "\n"


@dataclass
class TrainingStep:
    """A training step of the README's KITTI filter with Table I's image sensor."""

    rounds: int = 7  # measurements of each time
    out: Path | None = None  # write the table to this Markdown file
    smoke: bool = False  # a small batch, one round: does it run?

    def __call__(self) -> None:
        """Measures and prints."""
        began = time.perf_counter()
        batch, steps = (2, 3) if self.smoke else (BATCH, STEPS)
        timings = measure(1 if self.smoke else self.rounds, batch, steps)
        memory = {name: resident_mib(name, batch, steps) for name in OPTIONS}
        write_page(table(timings, memory, command("speed.training_step"), time.perf_counter() - began), self.out)


if __name__ == "__main__":
    parse(TrainingStep)()
