"""Measures how slowly a sensor's errors change, on episodes that train and choose filters: none is tested on."""

from __future__ import annotations

import torch

from benchmarks.g1.base import TrainedSensor
from benchmarks.g1.readings import read_codes
from benchmarks.g1.recordings import ARM
from benchmarks.g1.sensors import read_code

SAMPLES = 64
STEPS = (1, 10, 30)  # rows after which the errors' correlation is taken


@torch.no_grad()
def diagnose(sensor: TrainedSensor) -> str:
    """Returns a line of Markdown on one trained sensor."""
    (models, _), generator, errors = sensor.trained, torch.Generator().manual_seed(0), []
    for role in ("tune", "validation"):
        file = sensor.recordings.out / "codes" / f"{sensor.name}-{role}-clean.pt"
        hand, numbers = None if file.exists() else sensor.hand, getattr(sensor.roles, role)
        data = sensor.recordings.data
        for one in read_codes(models, data, hand, numbers, condition="clean", exact=False, file=file):
            at = one["valid"].squeeze(-1)
            read = read_code(models, one["code"][at], SAMPLES, generator)[0].mean(-2)
            errors.append((read - one["truth"][at])[:, : len(ARM)])
    parts = []
    for step in STEPS:
        both = sum((error[step:] * error[:-step]).sum() for error in errors)
        norm = sum((error[step:].square().sum() * error[:-step].square().sum()).sqrt() for error in errors)
        parts.append(f"{step}: {float(both / norm):.2f}")
    return f"Sensor `{sensor.name}`: correlation of the errors of all joints after so many rows: {', '.join(parts)}."
