"""How a sensor errs: where it was trained and where not, how slowly, and with which lag. No test episode has a say."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.common.tables import head, line
from benchmarks.g1.base import TrainedSensor
from benchmarks.g1.readings import read_codes
from benchmarks.g1.recordings import ARM
from benchmarks.g1.sensors import code_of, read_code

SAMPLES = 64
FRAMES = 1500  # of the training episodes
STEPS = (1, 10, 30)  # rows after which the errors' correlation is taken
LAGS = range(-6, 7)


@torch.no_grad()
def diagnose(sensor: TrainedSensor) -> list[str]:
    """Lines of Markdown on one trained sensor."""
    data, (models, _) = sensor.recordings.data, sensor.trained
    generator = torch.Generator().manual_seed(0)
    rows = sensor.seen(sensor.roles.sensor)
    rows = rows[:: max(len(rows) // FRAMES, 1)]
    codes = torch.cat([code_of(models, data[part]["pixels"]) for part in rows.split(64)])
    known = (read_code(models, codes, SAMPLES, generator)[0].mean(-2) - sensor.target[rows])[:, : len(ARM)].abs()
    errors, truths, seen = [], [], []
    for role in ("tune", "validation"):
        file = sensor.recordings.out / "codes" / f"{sensor.name}-{role}-clean.pt"
        numbers = getattr(sensor.roles, role)
        hand = None if file.exists() else sensor.hand
        unseen = read_codes(models, data, hand, numbers, condition="clean", exact=False, file=file)
        for one in unseen:
            at = one["valid"].squeeze(-1)
            read = read_code(models, one["code"][at], SAMPLES, generator)[0].mean(-2)[:, : len(ARM)]
            truth = one["truth"][at][:, : len(ARM)]
            errors.append(read - truth)
            truths.append(truth)
            seen.append(one["observed"][at].squeeze(-1))
    new = torch.cat([error[mask] for error, mask in zip(errors, seen, strict=True)])
    centred = torch.cat([(error - error[mask].mean(0))[mask] for error, mask in zip(errors, seen, strict=True)])
    whole = float(new.abs().rad2deg().mean())
    lines = [f"Sensor `{sensor.name}`: mean absolute error of the arm, degrees, frames that are no repeats", ""]
    lines += head("frames of", "degrees")
    lines.append(line("its training episodes", f"{float(known.rad2deg().mean()):.2f}"))
    lines.append(line("11 episodes that train and choose filters", f"{whole:.2f}"))
    lines.append(line("these, without each episode's mean error", f"{float(centred.abs().rad2deg().mean()):.2f}"))
    lines += ["", "Correlation of the errors, all joints, after so many rows: " + _correlations(errors) + ".", ""]
    by_lag = _lags(errors, truths, seen)
    lines += [
        "Error where the picture of a row is compared with the state of a later one: "
        + ", ".join(f"{lag:+d} {error:.2f}" for lag, error in by_lag.items())
        + "."
    ]
    return [*lines, ""]


def _correlations(errors: list[Tensor]) -> str:
    parts = []
    for step in STEPS:
        both = sum((error[step:] * error[:-step]).sum() for error in errors)
        norm = sum((error[step:].square().sum() * error[:-step].square().sum()).sqrt() for error in errors)
        parts.append(f"{step} row{'s' * (step > 1)} {float(both / norm):.2f}")
    return ", ".join(parts)


def _lags(errors: list[Tensor], truths: list[Tensor], seen: list[Tensor]) -> dict[int, float]:
    """Mean absolute errors in degrees, on the same rows for every lag."""
    far, out = max(LAGS), {}
    for lag in LAGS:
        parts = []
        for error, truth, mask in zip(errors, truths, seen, strict=True):
            inner = torch.arange(far, len(truth) - far)
            inner = inner[mask[inner]]
            parts.append(error[inner] + truth[inner] - truth[inner + lag])
        out[lag] = float(torch.cat(parts).abs().rad2deg().mean())
    return out
