"""The peers, if installed: VQF (``pip install vqf``), Madgwick's and Mahony's filters (``pip install ahrs``).

    python -m benchmarks.broad.peers --out benchmarks/broad/peers.json

chooses the gains of Madgwick's and Mahony's filters for each kind of motion on all others, at a quarter of the rate
(two minutes of one core).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from benchmarks.broad.task import Trial, first_orientation, read_trials, scores, simulated_trial
from benchmarks.common.arguments import command, parse
from torch_denkf.deployment.files import write_text
from torch_denkf.functional.manifolds import SO3

GAINS = Path(__file__).parent / "peers.json"
#: rad/s; proportional in 1/s and integral in 1/s^2. The defaults of ahrs are 0.041 and (1, 0.3).
GRIDS: dict[str, list] = {
    "Madgwick": [0.01, 0.02, 0.041, 0.08, 0.16],
    "Mahony": [[0.1, 0.001], [0.3, 0.001], [0.3, 0.01], [1.0, 0.01], [1.0, 0.3]],
}
PACKAGES = {"VQF": "vqf", "Madgwick": "ahrs", "Mahony": "ahrs"}


@dataclass(frozen=True)
class Peers:
    """Chooses the gains of Madgwick's and Mahony's filters."""

    data: Path = Path("../shared/data/broad")  # folder with .npz files of BROAD
    out: Path | None = None  # peers.json
    smoke: bool = False  # one simulated trial, one gain each


def has(name: str) -> bool:
    """Returns whether a peer's package is installed."""
    return find_spec(PACKAGES[name]) is not None


def vqf(trial: Trial) -> tuple[Tensor, Tensor]:
    """Returns orientations of VQF with its default settings, with 9 and with 6 axes."""
    from vqf import VQF

    sensors = (trial.gyro, trial.acceleration, trial.magnetometer)
    out = VQF(1 / trial.rate).updateBatch(*(value.numpy().copy() for value in sensors))
    return torch.as_tensor(out["quat9D"]), torch.as_tensor(out["quat6D"])


def gradient_filter(name: str, gain, trial: Trial, start: Tensor) -> Tensor:
    """Returns orientations of Madgwick's or Mahony's filter, 9 axes.

    Args:
        name: ``"Madgwick"`` or ``"Mahony"``.
        gain: beta; or the proportional and the integral gain.
        trial: with the readings.
        start: orientation before the first reading ``[4]``.
    """
    from ahrs import filters

    readings = [value.numpy() for value in (trial.gyro, trial.acceleration, trial.magnetometer)]
    east = SO3().exp(torch.tensor([0.0, 0.0, np.pi / 2], dtype=start.dtype))  # Madgwick's x is north
    if name == "Madgwick":
        run = filters.Madgwick(frequency=trial.rate, gain=gain)
        start = SO3().compose(SO3().inverse(east), start)
    else:
        run = filters.Mahony(frequency=trial.rate, k_P=gain[0], k_I=gain[1])
    q, found = start.numpy().copy(), np.empty((len(readings[0]), 4))
    for t, (gyro, force, field) in enumerate(zip(*readings, strict=True)):
        found[t] = q = run.updateMARG(q, gyro, force, field)
    out = torch.as_tensor(found)
    return SO3().compose(east.expand_as(out), out) if name == "Madgwick" else out


def slower(trial: Trial, times: int = 4) -> Trial:
    """Returns a trial with means over ``times`` readings, and the truth at the last of them."""
    count = len(trial.gyro) // times
    sensors = {
        name: getattr(trial, name)[: count * times].unflatten(0, (count, times)).mean(1)
        for name in ("gyro", "acceleration", "magnetometer")
    }
    at = slice(times - 1, count * times, times)
    return replace(
        trial, **sensors, orientation=trial.orientation[at], scored=trial.scored[at], rate=trial.rate / times
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs each filter with each gain on each trial, and writes for each kind the best gain on all others."""
    options = parse(Peers, arguments)
    trials = list(map(slower, [simulated_trial()] if options.smoke else read_trials(options.data)))
    page: dict = {"command": command("broad.peers"), "gains": {}}
    for name, grid in GRIDS.items():
        if not has(name):
            print(f"{name} is left out: pip install {PACKAGES[name]}")
            continue
        errors = []
        for gain in grid[:1] if options.smoke else grid:
            found = [gradient_filter(name, gain, trial, first_orientation(trial)) for trial in trials]
            errors.append([scores(trial, each)["total"] for trial, each in zip(trials, found, strict=True)])
            print(name, gain, [round(error, 2) for error in errors[-1]], flush=True)
        page["gains"][name] = {}
        for kind in [*dict.fromkeys(trial.kind for trial in trials), "all"]:
            others = [place for place, trial in enumerate(trials) if trial.kind != kind] or [0]
            best = min(range(len(errors)), key=lambda row: fmean(errors[row][place] for place in others))
            page["gains"][name][kind] = grid[best]
    if options.out is not None:
        write_text(options.out, json.dumps(page, indent=1) + "\n")


if __name__ == "__main__":
    main()
