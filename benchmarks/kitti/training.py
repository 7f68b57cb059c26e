"""Trains a filter on the frozen sensor's readings, then end to end; then chooses its inflation and speed factor.

The factor corrects the sensor's scale error of the speed, if that is significant on drives without training.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from scipy.stats import ttest_1samp
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.scores import belief_crps
from benchmarks.common.training import fit_filter
from benchmarks.kitti.folds import VELOCITIES, Fold, frame_sampler
from benchmarks.kitti.readings import read_spans
from benchmarks.kitti.recipes import FILTERS, KITTIRecipe
from benchmarks.kitti.sensors import SENSORS, SensorOfFold, sensor_loss
from torch_denkf.applications.car.odometry.batches import ReadingSampler, mark_start
from torch_denkf.applications.car.odometry.scores import EndToEndLoss, gain_of
from torch_denkf.applications.car.odometry.streams import all_frames, lose_frames
from torch_denkf.filters import Filter
from torch_denkf.training import Stage
from torch_denkf.training.checkpoint import read_checkpoint

INFLATIONS = (1.0, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4, 1.6, 2.0, 2.5, 3.2)
FLOOR = 1e-8  # of the variances of v and theta_dot


@dataclass(frozen=True)
class Budget:
    """Updates of each stage, and steps of the filter's windows."""

    sensor: int = 3000  # updates of the sensor
    fine_tuning: int = 300  # updates of a sensor that was pre-trained on rendered drives
    filter: int = 300  # updates of a filter on readings
    end_to_end: int = 40  # updates of sensor and filter together
    length: int = 24  # steps of the filter's windows


@torch.no_grad()
def run_filter(recipe: KITTIRecipe, model: Filter, readings: Sequence[TensorDict], seed: int = 0) -> TensorDict:
    """Filters readings of one length in a batch, ``[K, N]``, each from its true first state."""
    batch = mark_start(torch.stack([reading.copy() for reading in readings]))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return recipe.part(model, sensor=False).sequence(batch)


def run_all(recipe: KITTIRecipe, model: Filter, readings: Sequence[TensorDict]) -> list[TensorDict]:
    """Filters each drive's readings with all and with missing frames, in batches ``[K, N]`` of one length."""
    groups = defaultdict(list)
    for seed, reading in enumerate(readings):
        groups[len(reading)] += [all_frames(reading), lose_frames(reading, seed)]
    return [run_filter(recipe, model, group) for group in groups.values()]


def filter_error(recipe: KITTIRecipe, model: Filter, readings: Sequence[TensorDict]) -> dict[str, float]:
    """Returns the CRPS of (v, theta_dot) in units of a good sensor's errors, with and without missing frames."""
    return {"crps": _crps(recipe, run_all(recipe, model, readings))}


def _crps(recipe: KITTIRecipe, runs: Sequence[TensorDict]) -> float:
    scores = [belief_crps(out, VELOCITIES, recipe.unit, FLOOR).mean((1, 2)) for out in runs]
    return float(torch.cat(scores).mean())


def calibration_error(recipe: KITTIRecipe, model: Filter, readings: Sequence[TensorDict]) -> float:
    """Returns the CRPS of the velocities times the error of the path, with and without missing frames.

    A spread that is right for the velocities can be wrong for the path, which no reading corrects: the coverage of the
    velocities alone chooses an inflation that makes the path a fifth worse.
    """
    runs = run_all(recipe, model, readings)
    apart = [(out["belief", "mean"][..., :2] - out["state"][..., :2]).norm(dim=-1).mean(1) for out in runs]
    return _crps(recipe, runs) * float(torch.cat(apart).mean())


def log_gains(fold: Fold, base: SensorOfFold) -> Tensor:
    """Returns the logarithm of the read over the true speed, for each tuning drive without training of its sensor."""
    drives = zip(fold.tune, base.readings[::2], strict=True)
    clean = [torch.cat([first, last]) for part, (first, last, _) in drives if part.stream.condition == "clean"]
    return torch.stack([gain_of(reading) for reading in clean])


def certain_gain(gains: Tensor) -> float:
    """Returns the mean logarithm if it is significant (t test over the drives, 5 %), else 0."""
    if len(gains) < 3 or not ttest_1samp(gains.double().numpy(), 0.0).pvalue < 0.05:
        return 0.0
    return float(gains.mean())


def train_filter(
    fold: Fold,
    filter_name: str,
    base: SensorOfFold,
    *,
    out: Path,
    cache: Path,
    seed: int,
    budget: Budget,
    loggers: Sequence[str] = ("csv",),
) -> tuple[KITTIRecipe, Filter]:
    """Trains one filter on a fold, or resumes after an interruption; returns the best model."""
    torch.manual_seed(seed)
    facts, kind = base.facts, base.kind
    sensor = SENSORS[kind](facts)
    sensor.load_state_dict(base.sensor.state_dict())  # a copy of the fold's, because the last stage trains it
    recipe = FILTERS[filter_name](sensor, facts)
    model = recipe.build()
    gains = log_gains(fold, base)
    gain = certain_gain(gains)
    # Standard deviation of a training window's first state: the velocity is noisy, the pose is exact.
    start_std = torch.cat([torch.zeros(3), 0.2 * facts.scale])

    def objective(with_sensor: bool) -> nn.Module:
        return recipe.loss(recipe.part(model, sensor=with_sensor, start_std=start_std))

    def stages() -> list[Stage]:
        readings, weights = [tune for tune, _, _ in base.readings], [share for *_, share in base.readings]
        windows = ReadingSampler(readings, weights, budget.length, float(gains.square().mean().sqrt()))
        frames = frame_sampler(fold.train, cache, kind)
        third = max(budget.end_to_end // 3, 1)
        return [
            Stage(
                "filter",
                objective(with_sensor=False),
                lambda generator, _: windows.windows(generator, start_std),
                budget.filter,
                lr=5e-3,
                validate=lambda: filter_error(recipe, model, base.validation),
            ),
            Stage(
                "end_to_end",
                EndToEndLoss(objective(with_sensor=True), sensor_loss(sensor, facts.unit)),
                lambda generator, length: frames.windows(generator, length, start_std),
                budget.end_to_end,
                # The noise model was fitted to errors on new drives; training drives would make it overconfident.
                parameters=model.parameters(),
                frozen={"noise"} & set(model.module.keys()),
                lr=1e-4,
                lengths={0: 4, third: 8, 2 * third: 16},
                validate=lambda: filter_error(
                    recipe, model, [read_spans(sensor, part, cache, kind) for part in fold.validation]
                ),
            ),
        ]

    settings = {"validate_every": max(budget.filter // 3, 1), "save_every": 200, "loggers": loggers, "seed": seed}
    notes = {"filter": filter_name, "sensor": kind, "facts": vars(facts)}

    def error() -> float:
        return calibration_error(recipe, model, base.validation)

    def error_with(gain: float) -> float:
        recipe.set_gain(model, gain)
        return error()

    def gained_error() -> float:
        if "gain" not in notes:  # after the last stage, which may have removed the sensor's scale error
            notes["gain"] = min((0.0, gain), key=error_with)
            recipe.set_gain(model, notes["gain"])
        return error()

    fit_filter(recipe, model, stages, None, out=out, inflations=INFLATIONS, error=gained_error, notes=notes, **settings)
    recipe.set_gain(model, read_checkpoint(out / "filter.pt").get("gain", 0.0))
    return recipe, model
