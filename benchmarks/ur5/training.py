"""The stages of a filter: on readings of the frozen sensor, then with the sensor's head; then its one number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble, crps_gaussian
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import ImageSensor
from torch_denkf.training import FilterTrainer, Stage, read_checkpoint, write_checkpoint
from benchmarks.ur5.demos import JOINTS, STATE
from benchmarks.ur5.motion import ERRORS
from benchmarks.ur5.readings import Windows, fail, read_all, read_head, with_hint
from benchmarks.ur5.recipes import Recipe
from benchmarks.ur5.sensors import MEMBERS, Preset, unit_of

INFLATIONS = (0.75, 0.85, 1.0, 1.15, 1.3, 1.5, 1.75)


@dataclass(frozen=True)
class Budget:
    """Updates of each stage; steps of the filter's windows."""

    sensor: int = 5000
    fine_tuning: int = 600  # of the simulator's sensor, on the other domain
    motion: int = 3000
    filter: int = 250
    end_to_end: int = 50
    length: int = 32
    batch: int = 32


@torch.no_grad()
def run_filter(recipe: Recipe, model: Filter, readings: TensorDict, chunk: int = 128) -> TensorDict:
    """Filters demos ``[N, T]``, each from around its true first state."""
    behind, parts = recipe.behind(model), []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for part in readings.split(chunk):
            out = behind.sequence(with_hint(part.copy(), part["state"][:, 0]))
            parts.append(out.select(*[key for key in KEPT if key in out.keys(True)]))
    return torch.cat(parts)


KEPT = (("belief", "mean"), ("belief", "var"), ("belief", "ensemble"), ("belief", "log_weight"), "state", "observed")


def filter_error(recipe: Recipe, model: Filter, readings: Sequence[TensorDict]) -> dict[str, float]:
    """CRPS of the belief taken for a Gaussian, in the units of the loss, and mean absolute errors."""
    out = run_filter(recipe, model, torch.cat(list(readings)))
    mean, var = (out["belief", name][:, 1:, :STATE].flatten(0, 1) for name in ("mean", "var"))
    truth = out["state"][:, 1:].flatten(0, 1)
    error = (mean - truth).abs().mean(0)
    return {
        "crps": float((crps_gaussian(mean, var.clamp_min(1e-10), truth) / ERRORS).mean()),
        "joint_mae_deg": float(error[:JOINTS].mean().rad2deg()),
        "ee_mae_cm": 100 * float(error[JOINTS:].mean()),
    }


class WithHead(nn.Module):
    """The filter's objective with the sensor's head in front, and the head's own beside it."""

    def __init__(self, objective: nn.Module, sensor: ImageSensor, preset: Preset):
        super().__init__()
        self.objective, self.sensor, self.preset = objective, sensor, preset
        self.register_buffer("unit", unit_of(preset.dim))

    def forward(self, codes: TensorDict) -> dict[str, Tensor]:
        """All terms, of windows ``[B, T]`` of features."""
        windows = read_head(self.sensor, codes, MEMBERS)
        own = crps_ensemble(windows["sensor", "ensemble"], self.preset.observe(codes["state"])) / self.unit
        return {**self.objective(windows), "loss_sensor": 0.5 * own[codes["observed"].squeeze(-1)].mean()}


def train_filter(
    recipe: Recipe,
    tune: Sequence[TensorDict],
    validation: TensorDict,
    *,
    out: Path,
    seed: int,
    budget: Budget,
    begin: Filter | None = None,
) -> Filter:
    """Trains one filter on features of demos ``[N, T]``, or goes on where it was broken off.

    Args:
        recipe: with the trained sensor, whose head is changed.
        tune: demos whose sensor has not seen them.
        validation: demos to choose by.
        out: checkpoints and logs.
        seed: of all random numbers.
        budget: updates.
        begin: a trained filter to begin with: learns at a fifth of the rate, for a third of the updates.

    Returns:
        The model, on its best parameters, with its inflation.
    """
    torch.manual_seed(seed)
    model = recipe.build()
    if begin is not None:
        mine = {k: v for k, v in begin.state_dict().items() if not k.startswith("module.sensor.")}
        model.load_state_dict(mine, strict=False)
    sensor, done = recipe.sensor, out / "filter.pt"
    if done.exists():
        saved = read_checkpoint(done)
        model.load_state_dict(saved["model"])
        recipe.set_inflation(model, saved["inflation"])
        return model
    share, rate = (1, 1.0) if begin is None else (3, 0.2)
    windows = Windows(tune, budget.length, recipe.start_std)
    frozen = Windows([read_all(sensor, part, MEMBERS, seed + 1) for part in tune], budget.length, recipe.start_std)
    clean = read_all(sensor, validation, MEMBERS)

    def check(readings: TensorDict | None = None) -> dict[str, float]:
        readings = read_all(sensor, validation, MEMBERS) if readings is None else readings
        return filter_error(recipe, model, [readings, fail(readings, "missing", seed=1)])

    objective = recipe.loss(recipe.behind(model, training=True))
    head = list(sensor.module["head"].parameters())
    # R knows how wrong the sensor is on new demos; on those that it is now trained on it would forget.
    rest = [p for name, p in model.named_parameters() if not name.startswith(("module.noise.", "module.sensor."))]
    stages = [
        Stage(
            "filter",
            objective,
            lambda generator, _: frozen.sample(generator, budget.batch),
            max(budget.filter // share, 1),
            lr=5e-3 * rate,
            validate=lambda: check(clean),
        ),
        Stage(
            "end_to_end",
            WithHead(objective, sensor, recipe.preset),
            lambda generator, _: windows.sample(generator, budget.batch, max(budget.length // 2, 2)),
            max(budget.end_to_end // share, 1),
            parameters=[*head, *rest],
            lr=3e-4 * rate,
            validate=check,
        ),
    ]
    FilterTrainer(
        model,
        stages,
        out=out,
        monitor="crps",
        validate_every=max(budget.filter // share // 4, 1),
        save_every=100,
        seed=seed,
        device="cpu",
    ).fit()
    inflation = calibrate(recipe, model, read_all(sensor, validation, MEMBERS))
    write_checkpoint(done, {"model": model.state_dict(), "inflation": inflation})
    return model


def coverage(belief: TensorDict, level: float = 0.9) -> Tensor:
    """Share of the true joints inside the belief's intervals, ``[7]``; the first row is given."""
    mean, var = (belief["belief", name][:, 1:, :JOINTS].flatten(0, 1) for name in ("mean", "var"))
    return interval_coverage(mean, var.clamp_min(1e-12), belief["state"][:, 1:, :JOINTS].flatten(0, 1), level=level)


def calibrate(recipe: Recipe, model: Filter, readings: TensorDict, level: float = 0.9) -> float:
    """Sets the inflation with which the filter's intervals hold their share of the true joints."""
    distance = {}
    for inflation in INFLATIONS:
        recipe.set_inflation(model, inflation)
        out = run_filter(recipe, model, torch.cat([readings, fail(readings, "missing", seed=1)]))
        distance[inflation] = float((coverage(out).mean() - level).abs())
    best = min(distance, key=distance.get)
    recipe.set_inflation(model, best)
    return best
