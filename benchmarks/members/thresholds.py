"""Compares thresholds of the significance, and none: ``python -m benchmarks.members.thresholds``.

Small tasks with exact draws: the walks and the robot on wheels of this study, a target with only bearings, and linear
systems of 20 and 27 components, more than the rank of 16 members. Only validation data are scored.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import head, line, write_page
from benchmarks.members.tasks import Score, filtered, localised, scored, walks, wheels
from torch_denkf import UKF, DEnKF, KalmanFilter
from torch_denkf.functional.manifolds import Circle
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    GaussianPrior,
    LearnedTransition,
    LinearObservation,
    MomentPrior,
    SubModel,
)

MEAN, STD = [0.0, 6.0, 0.0, 0.0, 0.0], [2.0, 1.5, 0.12, 0.12, 0.06]  # of the target at the start
WALK, BEARING = [0.0, 0.0, 0.003, 0.003, 0.033], 0.02  # standard deviations of process noise and of a bearing, rad


@dataclass(frozen=True)
class Study:
    """Compares thresholds of the significance, and none."""

    out: Path | None = None  # folder for thresholds.md
    members: tuple[int, ...] = (16, 32, 64)
    thresholds: tuple[float, ...] = (1.0, 1.5, 2.0, 3.0)
    smoke: bool = False  # small: does it run?


def turned(state: Tensor) -> Tensor:
    """Returns targets ``[*, 5]``, place, speeds and turn rate, one step later."""
    x, y, vx, vy, turn = state.unbind(-1)
    vx, vy = turn.cos() * vx - turn.sin() * vy, turn.sin() * vx + turn.cos() * vy
    return torch.stack([x + vx, y + vy, vx, vy, 0.95 * turn], -1)


class Bearing(SubModel):
    """Measurement model of the bearing from an observer, at the entry ``"observer"`` ``[*B, 2]``."""

    def __init__(self):
        super().__init__(nn.Identity(), [("forecast", "ensemble"), "observer"], [("forecast", "observation")])

    def compute(self, ensemble, observer):
        """Returns the bearings ``[*B, E, 1]``."""
        away = ensemble[..., :2] - observer.unsqueeze(-2)
        return torch.atan2(away[..., :1], away[..., 1:])


def targets(runs: int, seed: int, steps: int = 40) -> TensorDict:
    """Returns targets with rare turns, a weaving observer, and bearings."""
    generator = torch.Generator().manual_seed(seed)
    draw, time = partial(torch.randn, generator=generator), torch.arange(steps)
    state, states = torch.tensor(MEAN) + torch.tensor(STD) * draw(runs, 5), []
    phase = 2 * math.pi * torch.rand(runs, 1, generator=generator)
    weave = 2 * (2 * math.pi * time / 24 + phase).sin()
    observer = torch.stack([weave, torch.zeros_like(weave)], -1)
    for t in range(steps):
        if t:
            state = turned(state) + torch.tensor([0.0, 0.0, 0.003, 0.003, 0.02]) * draw(runs, 5)
            jump = torch.rand(runs, generator=generator) < 0.03
            state[:, 4] = torch.where(jump, 0.15 * draw(runs), state[:, 4])
        states.append(state)
    state = torch.stack(states, 1)
    away = state[..., :2] - observer
    bearing = torch.atan2(away[..., :1], away[..., 1:]) + BEARING * draw(runs, steps, 1)
    return TensorDict({"state": state, "observer": observer, "reading": bearing}, [runs, steps])


@torch.no_grad()
def bearings(runs: int) -> tuple[Score, Callable[[int, float | None], Score]]:
    """Returns the UKF's score and a scorer of ensembles: median over runs, geometric mean over components."""
    data = targets(runs, 4)
    common = {"process_noise": WALK, "update_at_reset": True}
    reading = {"reading_space": Circle(), "observation_key": "reading"}
    parts = LearnedTransition(turned, residual=False), None, Bearing(), ConstantNoise([BEARING], in_key="reading")

    def of(filter) -> Score:
        torch.manual_seed(0)
        out = filter.sequence(data.clone())["belief"][:, 8:]
        truth = data["state"][:, 8:]
        errors = (out["mean"] - truth).square().mean(1).sqrt().nanmedian(0).values / torch.tensor(STD)
        return Score(float(errors.log().mean().exp()), scored(out["mean"], out["var"], truth).held)

    def score(members: int, threshold: float | None) -> Score:
        analysis = EnsembleAnalysis("etkf", **reading, **localised(threshold))
        initial = GaussianPrior(MEAN, STD, ensemble_size=members)
        return of(DEnKF(*parts, analysis, initial=initial, **common))

    start = MomentPrior(torch.tensor(MEAN), torch.tensor(STD).square().diag())
    return of(UKF(*parts, initial=start, **common, **reading)), score


def linear(size: int, read: int, runs: int) -> tuple[Score, Callable[[int, float | None], Score]]:
    """Returns the Kalman filter's score on a random stable system, and a scorer of ensembles."""
    generator = torch.Generator().manual_seed(size)
    draw = partial(torch.randn, generator=generator)
    f, h = 0.98 * torch.linalg.qr(draw(size, size))[0], draw(read, size) / size**0.5
    state, states = draw(runs, size), []
    for _ in range(60):
        state = state @ f.mT + 0.1 * draw(runs, size)
        states.append(state)
    state = torch.stack(states, 1)
    data = TensorDict({"state": state, "reading": state @ h.mT + 0.2 * draw(runs, 60, read)}, [runs, 60])
    move = nn.Linear(size, size, bias=False)
    move.weight.data = f

    def score(members: int, threshold: float | None) -> Score:
        filter = DEnKF(
            LearnedTransition(move, residual=False),
            None,
            LinearObservation(h),
            ConstantNoise([0.2] * read, in_key="reading"),
            EnsembleAnalysis("etkf", observation_key="reading", **localised(threshold)),
            process_noise=[0.1] * size,
            initial=GaussianPrior([0.0] * size, [1.0] * size, ensemble_size=members),
        )
        return filtered(filter, 0, data, 20)

    noises = {"process_noise": [0.1] * size, "noise": [0.2] * read}
    exact = KalmanFilter(f, h, **noises, mean=torch.zeros(size), cov=torch.eye(size), observation_key="reading")
    return filtered(exact, 0, data, 20), score


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    small = study.smoke
    tasks = {
        "bearings": bearings(4 if small else 400),
        "linear, S = 20, O = 4": linear(20, 4, 2 if small else 64),
        "linear, S = 27, O = 6": linear(27, 6, 2 if small else 64),
    }
    others = {
        "ten walks": walks(*((2, 20) if small else (8, 500))),
        "wheels": wheels(*((1, 20) if small else (8, 2000))),
    }
    for name, task in others.items():
        tasks[name] = task.validate(8 if small else 512, None), task.validate
    lines = ["# Threshold of significance", "", *head("task", "members", "none", *study.thresholds)]
    for name, (reference, score) in tasks.items():
        for members in (8,) if small else study.members:
            able = [one for one in study.thresholds if one**2 < members - 1]
            found = [score(members, threshold) for threshold in (None, *able)]
            cells = [f"{one.error / reference.error:.2f}, {one.held:.0%}" for one in found]
            lines.append(line(name, members, *cells, *[""] * (1 + len(study.thresholds) - len(cells))))
            print(lines[-1], flush=True)
    lines += [
        "",
        "Error over that of the unscented Kalman filter (bearings), the Kalman filter (linear) or 512 members; share "
        "of the truth within the 90 % intervals. Validation data.",
        "",
        *made_by("members.thresholds"),
    ]
    write_page("\n".join(lines) + "\n", None if study.out is None else study.out / "thresholds.md")


if __name__ == "__main__":
    main()
