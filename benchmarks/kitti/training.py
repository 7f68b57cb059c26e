"""The stages of a filter: on the frozen sensor's readings, then end to end; then its one number is chosen."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.kitti.folds import VELOCITIES, Fold, FrameSampler, Statistics
from benchmarks.kitti.readings import ReadingSampler, all_frames, lose_frames, read_spans
from benchmarks.kitti.recipes import FILTERS, Recipe
from benchmarks.kitti.sensors import SENSORS, SensorLoss, SensorOfFold
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_gaussian
from torch_denkf.metrics import interval_coverage
from torch_denkf.training import FilterTrainer, Stage, read_checkpoint

INFLATIONS = (1.0, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4)


@dataclass(frozen=True)
class Budget:
    """Updates of each stage; steps of the filter's windows."""

    sensor: int = 3000
    fine_tuning: int = 300  # of a sensor that comes trained on rendered drives
    filter: int = 300
    end_to_end: int = 40
    length: int = 24


@torch.no_grad()
def run_filter(recipe: Recipe, model: Filter, readings: Sequence[TensorDict]) -> TensorDict:
    """Filters readings of one length side by side, ``[K, N]``, each from its true first state."""
    batch = torch.stack([reading.copy() for reading in readings])
    batch["is_init"] = torch.zeros(*batch.batch_size, 1, dtype=torch.bool)
    batch["is_init"][:, 0] = True
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return recipe.part(model, sensor=False).sequence(batch)


def run_all(recipe: Recipe, model: Filter, readings: Sequence[TensorDict]) -> list[TensorDict]:
    """Filters each reading as it is and with missing frames; those of one length side by side, ``[K, N]``."""
    groups = defaultdict(list)
    for seed, reading in enumerate(readings):
        groups[len(reading)] += [all_frames(reading), lose_frames(reading, seed)]
    return [run_filter(recipe, model, group) for group in groups.values()]


def velocities(out: TensorDict) -> tuple[Tensor, Tensor, Tensor]:
    """Means and variances of a belief's (v, theta_dot), and the truth ``[*K, N - 1, 2]``: the first row is given."""
    values = out["belief", "mean"], out["belief", "var"], out["state"]
    mean, variance, truth = (value[..., 1:, VELOCITIES] for value in values)
    return mean, variance.clamp_min(1e-8), truth  # particles that are all the same have none, and no likelihood


def filter_error(recipe: Recipe, model: Filter, readings: Sequence[TensorDict]) -> dict[str, float]:
    """CRPS of the belief's (v, theta_dot), in units of a good sensor's errors, with and without missing frames."""
    scores = [
        (crps_gaussian(*velocities(out)) / recipe.facts.unit).mean((1, 2)) for out in run_all(recipe, model, readings)
    ]
    return {"crps": float(torch.cat(scores).mean())}


def gain_error(fold: Fold, base: SensorOfFold) -> float:
    """How far off a sensor's speed is over a whole drive that it has not seen: root mean square of the logarithm."""
    logarithms = []
    for part, (first, last, _) in zip(fold.tune, base.readings[::2], strict=True):
        if part.stream.condition == "clean":
            drive = all_frames(torch.cat([first, last]))[1:]
            read, driven = drive["sensor", "ensemble"].mean(-2)[..., 0], drive["state"][..., 3]
            logarithms.append((read.sum() / driven.sum()).clamp(0.5, 2.0).log())
    return float(torch.stack(logarithms).square().mean().sqrt())


class EndToEndLoss(nn.Module):
    """The filter's objective, and the sensor's own beside it."""

    def __init__(self, objective: nn.Module, sensor: SensorLoss):
        super().__init__()
        self.objective, self.sensor = objective, sensor

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """All terms."""
        own = {f"loss_sensor_{name[5:]}": 0.5 * value for name, value in self.sensor(frames.copy()).items()}
        return {**self.objective(frames), **own}


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
) -> tuple[Recipe, Filter]:
    """Trains one filter on a fold, or goes on where it was broken off; the model at the end is the best one."""
    torch.manual_seed(seed)
    facts, kind = base.facts, base.kind
    sensor = SENSORS[kind](facts)
    sensor.load_state_dict(base.sensor.state_dict())  # a copy of the fold's, because the last stage trains it
    recipe = FILTERS[filter_name](sensor, facts)
    model = recipe.build()
    # How wrong the first velocity of a training window is; its pose is right.
    start_std = torch.cat([torch.zeros(3), 0.2 * facts.scale])
    readings = [tune for tune, _, _ in base.readings]
    windows = ReadingSampler(readings, [share for *_, share in base.readings], budget.length, gain_error(fold, base))
    frames = FrameSampler(fold.train, cache, kind)
    third = max(budget.end_to_end // 3, 1)
    stages = [
        Stage(
            "filter",
            recipe.loss(recipe.part(model, sensor=False, start_std=start_std)),
            lambda generator, _: windows.windows(generator, start_std),
            budget.filter,
            lr=5e-3,
            validate=lambda: filter_error(recipe, model, base.validation),
        ),
        Stage(
            "end_to_end",
            EndToEndLoss(
                recipe.loss(recipe.part(model, sensor=True, start_std=start_std)), SensorLoss(sensor, facts.unit)
            ),
            lambda generator, length: frames.windows(generator, length, start_std),
            budget.end_to_end,
            # The noise model knows by now how wrong the sensor is on new drives; on those it has seen it would forget.
            parameters=[p for name, p in model.named_parameters() if not name.startswith("module.noise.")],
            lr=1e-4,
            lengths={0: 4, third: 8, 2 * third: 16},
            validate=lambda: filter_error(
                recipe, model, [read_spans(sensor, part, cache, kind) for part in fold.validation]
            ),
        ),
    ]
    FilterTrainer(
        model,
        stages,
        out=out,
        validate_every=max(budget.filter // 3, 1),
        save_every=200,
        loggers=loggers,
        seed=seed,
    ).fit()
    inflation = calibrate(recipe, model, base.validation)
    save_settings(out, filter_name, kind, facts, inflation)
    return recipe, model


def calibrate(recipe: Recipe, model: Filter, readings: Sequence[TensorDict], level: float = 0.9) -> float:
    """Sets the inflation with which the filter's intervals hold their share of the truth."""
    distance = {}
    for inflation in INFLATIONS:
        recipe.set_inflation(model, inflation)
        runs = run_all(recipe, model, readings)
        covered = torch.stack([interval_coverage(*map(_rows, velocities(out)), level=level) for out in runs]).mean(0)
        distance[inflation] = float((covered - level).abs().sum())
    best = min(distance, key=distance.get)
    recipe.set_inflation(model, best)
    return best


def _rows(value: Tensor) -> Tensor:
    return value.flatten(0, -2)


def save_settings(folder: Path, filter_name: str, kind: str, facts: Statistics, inflation: float) -> None:
    """Leaves beside the checkpoints what :func:`load_filter` needs to build the filter anew."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = {key: value.tolist() if isinstance(value, Tensor) else value for key, value in asdict(facts).items()}
    (folder / "filter.json").write_text(
        json.dumps({"filter": filter_name, "sensor": kind, "inflation": inflation, "statistics": numbers})
    )


def load_filter(folder: Path) -> tuple[Recipe, Filter, str, str]:
    """A recipe, its trained filter, and the names of filter and sensor.

    Raises:
        FileNotFoundError: if no training was finished in the folder.
    """
    if not (folder / "filter.json").exists() or not (folder / "best_end_to_end.pt").exists():
        raise FileNotFoundError(f"no finished training in {folder}: it lacks filter.json or best_end_to_end.pt")
    settings = json.loads((folder / "filter.json").read_text())
    numbers = settings["statistics"]
    facts = Statistics(**{k: torch.tensor(v) if isinstance(v, list) else v for k, v in numbers.items()})
    recipe = FILTERS[settings["filter"]](SENSORS[settings["sensor"]](facts), facts)
    model = recipe.build()
    model.load_state_dict(read_checkpoint(folder / "best_end_to_end.pt")["model"])
    recipe.set_inflation(model, settings["inflation"])
    return recipe, model, settings["filter"], settings["sensor"]
