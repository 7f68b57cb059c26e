"""Trains a filter on readings of the frozen sensor, then with the sensor's head; then chooses its inflation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from benchmarks.common.arm.readings import Windows, fail, read_all, with_head
from benchmarks.common.arm.scores import filter_error, filter_stage, fit
from benchmarks.ur5.recipes import UR5Recipe
from benchmarks.ur5.sensors import unit_of
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble
from torch_denkf.training import Stage
from torch_denkf.training.stage import parameters_without

INFLATIONS = (0.75, 0.85, 1.0, 1.15, 1.3, 1.5, 1.75, 2.0, 2.4)


@dataclass(frozen=True)
class Budget:
    """Updates of each stage, and the size of the filter's windows."""

    sensor: int = 6000  # updates of the sensor's coarse part; half as many of its patch network
    fine_tuning: int = 800  # updates of the simulator's sensor, on the other domain
    motion: int = 3000  # updates of the motion on true states
    filter: int = 250  # updates of a filter on readings
    end_to_end: int = 50  # updates of a filter with the sensor's head
    length: int = 96  # steps of the filter's windows: short ones do not show slow errors
    batch: int = 12  # windows in an update


def with_missing(recipe: UR5Recipe, codes: TensorDict) -> TensorDict:
    """Returns readings of clean demos, and the same with missing frames, for validation."""
    readings = read_all([recipe.sensor], codes, recipe.members)
    return torch.cat([readings, fail(readings, "missing", seed=1)])


class WithHead(nn.Module):
    """Objective of a filter with the sensor's head, plus the loss of the head itself."""

    def __init__(self, objective: nn.Module, recipe: UR5Recipe):
        super().__init__()
        self.objective, self.sensor, self.preset = objective, recipe.sensor, recipe.preset
        self.size = recipe.members
        self.register_buffer("unit", unit_of(self.preset.dim))

    def forward(self, codes: TensorDict) -> dict[str, Tensor]:
        """Returns all terms for windows ``[B, T]`` of features."""
        windows = with_head([self.sensor], codes, self.size)
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
    """Trains one filter on features of demos ``[N, T]``, or resumes after an interruption.

    Args:
        recipe: with the trained sensor, whose head is changed.
        tune: demos that the sensor was not trained on.
        validation: validation demos.
        out: folder for checkpoints and logs.
        seed: of all random numbers.
        budget: updates.
        begin: a trained filter to start from, with a fifth of the rate and a third of the updates.

    Returns:
        The model with its best parameters and its inflation.
    """
    torch.manual_seed(seed)
    model, sensor, (share, rate) = recipe.build(), recipe.sensor, (1, 1.0) if begin is None else (3, 0.2)
    if begin is not None:
        # The recipe sets the size of the errors in this domain.
        own = lambda name: name.startswith("module.sensor.") or name.endswith((".variance", ".floor"))  # noqa: E731
        model.load_state_dict({k: v for k, v in begin.state_dict().items() if not own(k)}, strict=False)
    read = lambda: with_missing(recipe, validation)  # noqa: E731

    def stages() -> list[Stage]:
        windows = Windows(tune, budget.length)
        frozen = Windows([read_all([sensor], part, recipe.members, seed + 1) for part in tune], budget.length)
        updates = max(budget.filter // share, 1)
        first = filter_stage(recipe, model, frozen, read(), updates, budget.batch, lr=5e-3 * rate)
        head = list(sensor.module["head"].parameters())
        # R was fitted to errors on new demos; the demos of this stage would make it overconfident.
        rest = parameters_without(model, {"noise", "sensor"} & set(model.module.keys()))

        def sample(generator: torch.Generator, _: int | None) -> TensorDict:
            return recipe.begun(windows.sample(generator, budget.batch, max(budget.length // 2, 2)), generator)

        second = Stage(
            "end_to_end",
            WithHead(first.loss, recipe),
            sample,
            max(budget.end_to_end // share, 1),
            parameters=[*head, *rest],
            lr=3e-4 * rate,
            validate=lambda: filter_error(recipe, model, read()),
        )
        return [first, second]

    # After training the sensor's head is frozen.
    settings = {"inflations": INFLATIONS, "every": budget.filter // share // 4, "out": out, "seed": seed}
    return fit(recipe, model, stages, cache(read), **settings)
