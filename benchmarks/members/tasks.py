"""The tasks: each makes data once, and scores filters with any number of members."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.arms.arms import ARMS
from benchmarks.arms.study import Study, collect, trained
from benchmarks.common.lorenz96 import lorenz96_step
from benchmarks.control.cartpole import STEPS, NoisyCartpole, exact_filter
from benchmarks.wheels.task import ensemble_filter, gaussian_filter, recordings
from torch_denkf import DEnKF, Filter, KalmanFilter, from_pretrained
from torch_denkf.applications.reacher import reacher_env
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
from torch_denkf.applications.ur5.filter import UR5TableSettings
from torch_denkf.applications.ur5.train import evaluate_ur5_table
from torch_denkf.functional import analyse
from torch_denkf.functional.inflation import inflate
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import ConstantNoise, EnsembleAnalysis, GaussianPrior, LearnedTransition, Select

LEVEL = 0.9  # of the intervals
#: Error of each task, with its unit.
ERRORS = {
    "walks": "error of the walks",
    "reacher": "velocities, rad/s",
    "cartpole": "velocities",
    "manipulator": "velocities, rad/s",
    "lorenz96": "error of the analysis",
    "wheels": "place, m",
    "ur5": "joints, degrees",
}
WALKS, WALK_STD, READING_STD = 10, 0.1, 0.5  # number of walks, standard deviations of a step and of a reading


@dataclass(frozen=True)
class Score:
    """Error of a filter in the task's unit, and coverage of its 90 % intervals."""

    error: float
    held: float


@dataclass(frozen=True)
class Task:
    """A task.

    Attributes:
        name: of the task.
        make: returns a filter from its number of members, and the threshold of the significance or ``None``.
        test: scores such a filter with a seed.
        validation: the same on validation data, by which the threshold is chosen.
        reference: name and score of a filter without members; ``None`` for none.
    """

    name: str
    make: Callable[[int, float | None], Any]
    test: Callable[[Any, int], Score]
    validation: Callable[[Any, int], Score]
    reference: tuple[str, Score] | None = None

    def score(self, members: int, threshold: float | None) -> Score:
        """Scores a filter on the test data."""
        return self.test(self.make(members, threshold), 0)

    def validate(self, members: int, threshold: float | None) -> Score:
        """Scores a filter on the validation data."""
        return self.validation(self.make(members, threshold), 0)


def localised(threshold: float | None) -> dict[str, Any]:
    """Returns the options of an analysis."""
    return {} if threshold is None else {"localisation": "significance", "threshold": threshold}


def scored(mean: Tensor, var: Tensor, truth: Tensor, dims: slice = slice(None)) -> Score:
    """Returns the root mean square error of some components ``dims``, and the coverage of all, over ``[*B, S]``."""
    parts = [value.flatten(0, -2) for value in (mean, var, truth)]
    error = (parts[0] - parts[2])[:, dims].square().mean().sqrt()
    return Score(float(error), float(interval_coverage(*parts, level=LEVEL).mean()))


@torch.no_grad()
def filtered(filter: Filter, seed: int, data: TensorDict, skip: int, dims: slice = slice(None)) -> Score:
    """Returns the score on sequences ``[B, T]`` without their first steps."""
    torch.manual_seed(seed)
    out = filter.sequence(data.clone(), keep=[("belief", "mean"), ("belief", "var")])["belief"][:, skip:]
    return scored(out["mean"], out["var"], data["state"][:, skip:], dims)


def wheels(runs: int = 8, steps: int = 6000) -> Task:
    """Returns the robot on wheels of ``benchmarks.wheels``: fast sensors, slow GPS."""
    test, other = recordings(runs, steps, 0), recordings(runs, steps, 1)
    scores = [partial(filtered, data=data, skip=min(500, steps // 2), dims=slice(0, 2)) for data in (test, other)]

    def make(members: int, threshold: float | None) -> Filter:
        return ensemble_filter(members, **localised(threshold))

    return Task("wheels", make, *scores, ("EKF", scores[0](gaussian_filter(), 0)))


def _walks(runs: int, steps: int, seed: int) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    draw = partial(torch.randn, runs, steps, WALKS, generator=generator)
    state = (WALK_STD * draw()).cumsum(1)
    read = torch.arange(steps).unsqueeze(-1) % WALKS == torch.arange(WALKS)
    observed = read.expand(runs, -1, -1).contiguous()
    return TensorDict({"state": state, "reading": state + READING_STD * draw(), "observed": observed}, [runs, steps])


def walks(runs: int = 16, steps: int = 1000) -> Task:
    """Returns the task of ten independent random walks, one of which is read at each step."""
    test, other = _walks(runs, steps, 0), _walks(runs, steps, 1)
    scores = [partial(filtered, data=data, skip=min(100, steps // 2)) for data in (test, other)]
    eye = torch.eye(WALKS)

    def make(members: int, threshold: float | None) -> Filter:
        still = torch.nn.Linear(WALKS, WALKS, bias=False)
        still.weight.data = torch.eye(WALKS)
        return DEnKF(
            LearnedTransition(still, residual=False),
            None,
            Select(range(WALKS)),
            ConstantNoise([READING_STD] * WALKS, in_key="reading"),
            EnsembleAnalysis("etkf", observation_key="reading", **localised(threshold)),
            process_noise=[WALK_STD] * WALKS,
            initial=GaussianPrior([0.0] * WALKS, [WALK_STD] * WALKS, ensemble_size=members),
        )

    noises = {"process_noise": [WALK_STD] * WALKS, "noise": [READING_STD] * WALKS}
    exact = KalmanFilter(eye, eye, **noises, mean=torch.zeros(WALKS), cov=WALK_STD**2 * eye, observation_key="reading")
    return Task("walks", make, *scores, ("Kalman filter", scores[0](exact, 0)))


def _weather(seeds: int, cycles: int, first: int) -> tuple[Tensor, Tensor]:
    """Returns true states and readings of Lorenz-96, ``[cycles + 1, seeds, 40]``."""
    generator = torch.Generator().manual_seed(first)
    draw = partial(torch.randn, seeds, 40, generator=generator, dtype=torch.float64)
    state = 8 + draw()
    for _ in range(1000):
        state = lorenz96_step(state)
    truth = [state]
    for _ in range(cycles):
        truth.append(lorenz96_step(truth[-1]))
    return torch.stack(truth), torch.stack([state + draw() for state in truth])


def lorenz96(seeds: int = 4, cycles: int = 600, inflations: tuple[float, ...] = (1.0, 1.02, 1.05, 1.1)) -> Task:
    """Returns the task of Lorenz-96 with R = 1 and all variables read in each cycle; validation picks inflation."""
    data = {"validation": _weather(seeds, cycles, 1), "test": _weather(seeds, cycles, 0)}
    chosen: dict[tuple[int, float | None], int] = {}

    def run(name: str, members: int, threshold: float | None) -> list[Score]:
        truth, readings = data[name]
        factor = torch.tensor(inflations, dtype=torch.float64).repeat_interleave(seeds)[:, None, None]
        generator = torch.Generator().manual_seed(2)
        start = torch.randn(seeds, members, 40, generator=generator, dtype=torch.float64)
        ensemble = (truth[0].unsqueeze(1) + start).repeat(len(inflations), 1, 1)
        noise, found = torch.ones_like(ensemble[:, 0]), []
        for reading in readings[1:]:
            ensemble = lorenz96_step(ensemble).clamp(-50, 50)  # keeps diverged members finite
            reading = reading.repeat(len(inflations), 1)
            options: dict[str, Any] = {"scheme": "etkf", "significance": threshold}
            ensemble = inflate(analyse(ensemble, ensemble, reading, noise, **options).ensemble, factor)
            found.append(torch.stack([ensemble.mean(1), ensemble.var(1)]).unflatten(1, (len(inflations), seeds)))
        means, variances = torch.stack(found, 3)[:, :, :, min(100, cycles // 2) :].unbind()  # [factor, seed, cycle, 40]
        true = truth[1:].movedim(0, 1)[:, min(100, cycles // 2) :]
        scores = []
        for mean, var in zip(means, variances, strict=True):
            error = (mean - true).square().mean(-1).sqrt().mean()  # the mean of the cycles' errors, as published
            scores.append(replace(scored(mean, var, true), error=float(error)))
        return scores

    def make(members: int, threshold: float | None) -> tuple[int, float | None]:
        return members, threshold

    def validate(setting: tuple[int, float | None], seed: int) -> Score:
        scores = run("validation", *setting)
        chosen[setting] = min(range(len(scores)), key=lambda place: scores[place].error)
        return scores[chosen[setting]]

    def score(setting: tuple[int, float | None], seed: int) -> Score:
        if setting not in chosen:
            validate(setting, seed)
        return run("test", *setting)[chosen[setting]]

    return Task("lorenz96", make, score, validate)


def manipulator(folder: Path, demos: int = 100, updates: int = 8000) -> Task:
    """Returns the task of the joint velocities of dm_control's manipulator, with the filter of ``benchmarks.arms``.

    Its state has dimension 12 (cosine, sine and velocity of each joint), of which noisy encoders read 8.
    """
    arm = ARMS["manipulator"]
    shipped = trained(arm, False, Study(demos=demos, motion_updates=updates), folder)
    data = [collect(arm, False, 60, 200, seed) for seed in (1000, 2000)]

    def make(members: int, threshold: float | None) -> Filter:
        shipped.initial.ensemble_size = members
        return localise(shipped, threshold)

    dims = slice(2 * arm.joints, None)
    return Task("manipulator", make, *(partial(filtered, data=each, skip=1, dims=dims) for each in data))


def localise(filter: Filter, threshold: float | None) -> Filter:
    """Switches significance on or off in a filter, in place, and returns it."""
    for module in filter.modules():
        if isinstance(module, EnsembleAnalysis):
            module.localisation, module.threshold = (None, 3.0) if threshold is None else ("significance", threshold)
    return filter


def resized(filter: Any, members: int, threshold: float | None) -> Any:
    """Returns a pretrained filter with another number of members and the noise models of its training."""
    new = type(filter)(replace(filter.settings, ensemble_size=members))
    new.load_state_dict(filter.state_dict())
    return localise(new.eval(), threshold)


def reacher(episodes: int = 10, steps: int = 400) -> Task:
    """Returns the task of the reacher's joint velocities under random actions, with the pretrained filter."""
    scores = []
    for seed in (1000, 2000):
        torch.manual_seed(seed)
        env, keys = reacher_env(seed), ("state", "encoder", "action")
        data = TensorDict.stack([env.rollout(steps).select(*keys) for _ in range(episodes)])
        scores.append(partial(filtered, data=data, skip=1, dims=slice(2, 4)))
    return Task("reacher", partial(resized, from_pretrained("reacher")), *scores)


def _pushes(noise: float, episodes: int, seed: int) -> TensorDict:
    torch.manual_seed(seed)
    keys = ("state", "observation", "observed", "action")
    return NoisyCartpole(episodes, noise, missing=0.3, seed=seed).rollout(STEPS).select(*keys)


def cartpole(noise: float = 0.3, episodes: int = 20) -> Task:
    """Returns the task of the cartpole's velocities under random actions, with a filter that has its physics."""
    data = [_pushes(noise, episodes, seed) for seed in (0, 1)]

    def make(members: int, threshold: float | None) -> Filter:
        return localise(exact_filter(noise, members), threshold)

    return Task("cartpole", make, *(partial(filtered, data=each, skip=1, dims=slice(3, 5)) for each in data))


def ur5(folder: Path, demos: int = 200, others: int = 100) -> Task:
    """Returns the task of the UR5's joints at its table, with the pretrained filter."""
    side = UR5TableSettings.pixels
    collect_ur5_demos(folder / "test", demos, size=(side, side), seed=0)
    collect_ur5_demos(folder / "validation", others, size=(side, side), seed=1)

    def score(data: Path, filter: Filter, seed: int) -> Score:
        torch.manual_seed(seed)
        found = evaluate_ur5_table(filter, data, cache=folder / "cache", progress=False)
        return Score(found["filter"]["joints, deg"], found["held by 90 % intervals"])

    scores = [partial(score, folder / name) for name in ("test", "validation")]
    return Task("ur5", partial(resized, from_pretrained("ur5-table")), *scores)
