"""The stages of a filter: on readings of the frozen sensor, then with the sensor's head; then its one number."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.scores import belief_crps, counted, coverage
from benchmarks.common.training import fit_filter
from benchmarks.ur5.demos import JOINTS
from benchmarks.ur5.readings import Windows, read_all, read_head, with_missing
from benchmarks.ur5.recipes import UR5Recipe
from benchmarks.ur5.sensors import unit_of
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble
from torch_denkf.training import Stage
from torch_denkf.training.stage import parameters_without

INFLATIONS = (0.75, 0.85, 1.0, 1.15, 1.3, 1.5, 1.75, 2.0, 2.4)
KEPT = (("belief", "mean"), ("belief", "var"), ("belief", "ensemble"), "state", "observed")


@dataclass(frozen=True)
class Budget:
    """Updates of each stage; the filter's windows."""

    sensor: int = 6000  # updates of the sensor's coarse part; half as many of its second look
    fine_tuning: int = 800  # updates of the simulator's sensor, on the other domain
    motion: int = 3000  # updates of the motion on true states
    filter: int = 250  # updates of a filter on readings
    end_to_end: int = 50  # updates of a filter with the sensor's head
    length: int = 96  # steps of the filter's windows: over short ones slow errors do not show
    batch: int = 12  # windows an update


@torch.no_grad()
def run_filter(recipe: UR5Recipe, model: Filter, readings: TensorDict, chunk: int = 128) -> TensorDict:
    """Filters demos ``[N, T]``, each from around its true first state."""
    behind, parts = recipe.behind(model), []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        for part in readings.split(chunk):
            out = behind.sequence(part.copy())
            parts.append(out.select(*[key for key in KEPT if key in out.keys(True)]))
    return torch.cat(parts)


def filter_error(recipe: UR5Recipe, model: Filter, readings: TensorDict) -> dict[str, float]:
    """CRPS of the belief taken for a Gaussian, in the units of the loss, and mean absolute errors."""
    out = run_filter(recipe, model, readings)
    mean, _, truth = counted(out, recipe.dims, 0.0)
    error = (mean - truth).abs().flatten(0, 1).mean(0)
    return {
        "crps": float(belief_crps(out, recipe.dims, recipe.unit, 1e-10).mean()),
        "joint_mae_deg": float(error[:JOINTS].mean().rad2deg()),
        "ee_mae_cm": 100 * float(error[JOINTS:].mean()),
    }


def joint_coverage(out: TensorDict) -> Tensor:
    """Share of the true joints inside the belief's 90 % intervals."""
    return coverage(out, range(JOINTS), 1e-12).mean()


class WithHead(nn.Module):
    """The filter's objective with the sensor's head in front, and the head's own beside it."""

    def __init__(self, objective: nn.Module, recipe: UR5Recipe):
        super().__init__()
        self.objective, self.sensor, self.preset = objective, recipe.sensor, recipe.preset
        self.size = recipe.ensemble_size
        self.register_buffer("unit", unit_of(self.preset.dim))

    def forward(self, codes: TensorDict) -> dict[str, Tensor]:
        """All terms, of windows ``[B, T]`` of features."""
        windows = read_head(self.sensor, codes, self.size)
        own = crps_ensemble(windows["sensor", "ensemble"], self.preset.observe(codes["state"])) / self.unit
        return {**self.objective(windows), "loss_sensor": 0.5 * own[codes["observed"].squeeze(-1)].mean()}


def train_filter(
    recipe: UR5Recipe,
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
    model, sensor = recipe.build(), recipe.sensor
    if begin is not None:
        # How large errors are here says the recipe.
        errors = (".variance", ".floor")
        mine = {
            name: value
            for name, value in begin.state_dict().items()
            if not name.startswith("module.sensor.") and not name.endswith(errors)
        }
        model.load_state_dict(mine, strict=False)
    share, rate = (1, 1.0) if begin is None else (3, 0.2)

    def read() -> TensorDict:
        return with_missing(read_all(sensor, validation, recipe.ensemble_size))

    def stages() -> list[Stage]:
        windows = Windows(tune, budget.length, recipe.start_std)
        read_once = [read_all(sensor, part, recipe.ensemble_size, seed + 1) for part in tune]
        frozen = Windows(read_once, budget.length, recipe.start_std)
        objective, clean = recipe.loss(recipe.behind(model, training=True)), read()
        head = list(sensor.module["head"].parameters())
        # R knows how wrong the sensor is on new demos; on those that it is now trained on it would forget.
        rest = parameters_without(model, {"noise", "sensor"} & set(model.module.keys()))
        return [
            Stage(
                "filter",
                objective,
                lambda generator, _: frozen.sample(generator, budget.batch),
                max(budget.filter // share, 1),
                lr=5e-3 * rate,
                validate=lambda: filter_error(recipe, model, clean),
            ),
            Stage(
                "end_to_end",
                WithHead(objective, recipe),
                lambda generator, _: windows.sample(generator, budget.batch, max(budget.length // 2, 2)),
                max(budget.end_to_end // share, 1),
                parameters=[*head, *rest],
                lr=3e-4 * rate,
                validate=lambda: filter_error(recipe, model, read()),
            ),
        ]

    trained = cache(read)  # after training the sensor's head stays as it is
    settings = {"monitor": "crps", "validate_every": max(budget.filter // share // 4, 1), "save_every": 100}
    fit_filter(
        recipe,
        model,
        stages,
        lambda: joint_coverage(run_filter(recipe, model, trained())),
        out=out,
        inflations=INFLATIONS,
        seed=seed,
        device="cpu",
        **settings,
    )
    return model
