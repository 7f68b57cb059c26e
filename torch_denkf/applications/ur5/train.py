"""Trains the filter ``ur5-table``: collects demos, trains the sensor on single frames, then the filter on readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from torch_denkf.applications.ur5.data.replay import UR5ExperienceReplay
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos
from torch_denkf.applications.ur5.filter import JOINTS, UR5TableFilter, UR5TableSettings, ur5_table
from torch_denkf.deployment.progress import progress_bar
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble
from torch_denkf.metrics import interval_coverage
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.pretrained.folders import save_pretrained
from torch_denkf.training import Stage, choose
from torch_denkf.training.parts import train_part
from torch_denkf.training.trainer import FilterTrainer

__all__ = ["evaluate_ur5_table", "whole_demos", "train_ur5_table"]

UNIT = torch.tensor([0.02] * JOINTS + [0.0025] * 3)  # rad and m: what counts as an error of one
_INFLATIONS = (1.0, 1.01, 1.02, 1.03, 1.05, 1.07, 1.1, 1.15, 1.2, 1.3)
_THRESHOLD = 1.0  # of significance, behind the training; by the CRPS of demos that are for neither training nor tests
_LENGTH, _MISSING = 32, 0.3  # steps of a window; share of the frames that are lost in half of them


def train_ur5_table(
    out: Path,
    *,
    seed: int = 0,
    demos: int = 800,
    sequences: int = 60,
    sensor_updates: int = 2400,
    filter_updates: int = 300,
    processes: int = 1,
    command: str = "",
    progress: bool = True,
) -> UR5TableFilter:
    """Collects missing demos, trains the filter and writes it to a folder; a repeated call continues.

    Demos below ``sequences`` are the filter's, so that it sees how wrong its sensor is on new ones; the others are the
    sensor's. The replay's hash decides which demos are for tests; those are in neither.

    Args:
        out: folder of the filter, with demos below ``demos`` and checkpoints and logs below ``training``.
        seed: of all random numbers.
        demos: with 16 frames each.
        sequences: of these demos, whole.
        sensor_updates: of the sensor, on single frames.
        filter_updates: of the filter, on the sensor's readings.
        processes: that collect at a time.
        command: how this was called, for the record.
        progress: whether bars say how far it is.
    """
    _collect(out / "demos/sequences", sequences, 0, processes, progress)
    _collect(out / "demos/frames", demos, 16, processes, progress)
    torch.manual_seed(seed)
    options: dict[str, Any] = {"cache": out / "cache", "progress": progress}
    pool = _frames(UR5ExperienceReplay(out / "demos/frames", split="train", frames_only=True, **options), sequences)
    whole = _sequences(UR5ExperienceReplay(out / "demos/sequences", split="train", **options))
    model = ur5_table(**_statistics(pool))
    trainer = {"seed": seed, "device": "cpu", "progress": progress}
    _train_sensor(model, pool, whole[::4, ::10].flatten(), sensor_updates, out / "training/sensor", trainer)
    readings = read_demos(model, whole)
    held = max(len(whole) // 5, 1)
    # The errors that the sensor makes on demos it has not seen are where the noise model begins.
    error = (readings["sensor", "ensemble"].mean(-2) - readings["state"]).flatten(0, 1).square().mean(0).sqrt()
    sensor = model["sensor"].state_dict()
    model = ur5_table(**_statistics(pool), sensor_std=tuple(error.tolist()))
    model["sensor"].load_state_dict(sensor)
    _train_filter(model, readings[held:], readings[:held], filter_updates, out / "training/filter", trainer)
    record = {"command": command, "seed": seed, "demos": demos, "sequences": sequences}
    record |= {"sensor_updates": sensor_updates, "filter_updates": filter_updates}
    localised = UR5TableFilter(replace(model.settings, threshold=_THRESHOLD))
    localised.load_state_dict(model.state_dict())
    save_pretrained(localised, out, training=record)
    return localised.eval()


def whole_demos(out: Path, sequences: int = 60, *, processes: int = 1, progress: bool = True) -> Path:
    """Returns the folder of whole demos, a fifth of them for tests by the replay's hash; collects missing ones."""
    folder = out / "demos/sequences"
    _collect(folder, sequences, 0, processes, progress)
    return folder


def _collect(folder: Path, demos: int, frames: int, processes: int, progress: bool) -> None:
    side = UR5TableSettings.pixels
    with progress_bar(f"collecting {folder.name}", demos, unit=" demos", shown=progress) as bar:
        collect_ur5_demos(folder, demos, size=(side, side), frames=frames, processes=processes, progress=bar.update)


def _frames(data: UR5ExperienceReplay, first: int) -> TensorDict:
    """Returns single frames of the demos from ``first`` on, pixels as uint8."""
    chosen = torch.tensor([episode.demo >= first for episode in data.episodes])
    rows = chosen[data.storage[:]["episode"]].nonzero().squeeze(-1)
    parts = [data[index].select("pixels", "state") for index in rows.split(512)]
    return torch.cat([part.set("pixels", (part["pixels"] * 255).round().to(torch.uint8)) for part in parts])


def _sequences(data: UR5ExperienceReplay) -> TensorDict:
    """Returns whole demos ``[N, T]``; T is the shortest one's length."""
    steps = min(episode.length for episode in data.episodes)
    rows = [data[torch.arange(e.start, e.start + steps)].select("pixels", "state", "action") for e in data.episodes]
    return torch.stack([row.set("pixels", (row["pixels"] * 255).round().to(torch.uint8)) for row in rows])


def _statistics(pool: TensorDict) -> dict[str, tuple[float, ...]]:
    pixels = pool["pixels"][:: max(len(pool) // 500, 1)].float() / 255
    values = {
        "state_mean": pool["state"].mean(0),
        "state_std": pool["state"].std(0),
        "pixel_mean": pixels.mean((0, 2, 3)),
        "pixel_std": pixels.std((0, 2, 3)),
    }
    return {name: tuple(value.tolist()) for name, value in values.items()}


class _SensorLoss(nn.Module):
    """CRPS of the sensor's samples against the true state."""

    def __init__(self, sensor: nn.Module):
        super().__init__()
        self.sensor = sensor

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """Scores frames ``[n]``."""
        score = crps_ensemble(self.sensor(frames)["sensor", "ensemble"], frames["state"]) / UNIT
        return {"loss_sensor": score.mean()}


def _train_sensor(
    model: UR5TableFilter, pool: TensorDict, held_out: TensorDict, updates: int, out: Path, trainer: dict[str, Any]
) -> None:
    loss = _SensorLoss(model["sensor"])

    def sample(generator: torch.Generator, _):
        frames = pool[torch.randint(len(pool), (64,), generator=generator)]
        light = 0.9 + 0.2 * torch.rand(64, 1, 1, 1, generator=generator)
        return frames.set("pixels", (frames["pixels"].float() / 255 * light).clamp(0, 1))

    def error() -> dict[str, float]:
        with torch.no_grad(), torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            scores = [loss(part.copy())["loss_sensor"] for part in held_out.split(256)[:4]]
            return {"crps": float(torch.stack(scores).mean())}

    stage = Stage("sensor", loss, sample, updates, lr=2e-3, weight_decay=0.02, validate=error)
    train_part(model["sensor"], stage, out=out, validate_every=max(updates // 8, 1), save_every=500, **trainer)


@torch.no_grad()
def read_demos(model: UR5TableFilter, demos: TensorDict, seed: int = 0) -> TensorDict:
    """Runs the sensor on whole demos ``[N, T]``: samples and encodings instead of the pixels."""
    parts = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for demo in demos:
            read = model["sensor"](demo.copy())
            parts.append(read.select("sensor", "state", "action"))
    return torch.stack(parts)


def behind_sensor(model: UR5TableFilter) -> Filter:
    """Returns this filter for precomputed readings of its sensor."""
    names = [name for name in model.module if name != "sensor"]
    parts = {name: model[name] for name in names}
    return Filter(parts, initial=model.initial, update_at_reset=model.update_at_reset)


def _train_filter(
    model: UR5TableFilter,
    readings: TensorDict,
    held_out: TensorDict,
    updates: int,
    out: Path,
    trainer: dict[str, Any],
) -> None:
    behind = behind_sensor(model)
    loss = DEnKFLoss(behind, state=1.0, transition=0.5, sensor=0.0, state_scale=UNIT)

    def sample(generator: torch.Generator, _):
        rows = torch.randint(readings.shape[0], (32, 1), generator=generator)
        starts = torch.randint(readings.shape[1] - _LENGTH + 1, (32, 1), generator=generator)
        windows = readings[rows, starts + torch.arange(_LENGTH)]
        lost = torch.rand(32, 1, 1, generator=generator).sub(0.5).clamp_min(0) * 2 * _MISSING
        return windows.set("observed", torch.rand(32, _LENGTH, 1, generator=generator) >= lost)

    def error() -> dict[str, float]:
        out = _believe(behind, held_out)
        return {"crps": float((crps_ensemble(out["belief", "ensemble"], out["state"]) / UNIT).mean())}

    stage = Stage("filter", loss, sample, updates, lr=4e-3, validate=error)
    FilterTrainer(behind, [stage], out=out, validate_every=max(updates // 6, 1), **trainer).fit()

    def coverage_error() -> float:
        out = _believe(behind, held_out)
        parts = (out["belief", "mean"], out["belief", "var"], out["state"])
        return abs(float(interval_coverage(*(part.flatten(0, 1) for part in parts), level=0.9).mean()) - 0.9)

    choose(_INFLATIONS, lambda factor: setattr(model, "inflation", factor), coverage_error)


@torch.no_grad()
def _believe(behind: Filter, readings: TensorDict, seed: int = 0) -> TensorDict:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return behind.sequence(readings.copy())


@torch.no_grad()
def evaluate_ur5_table(
    model: UR5TableFilter, demos: str | Path, *, missing: float = 0.0, cache: Path | bool = True, progress: bool = True
) -> dict[str, Any]:
    """Returns errors on whole demos of the test side, next to the sensor alone.

    Args:
        model: the filter.
        demos: folder of whole demos at 64 px.
        missing: share of the frames to lose.
        cache: folder of the decoded demos, see :class:`torch_denkf.applications.ur5.UR5ExperienceReplay`.
        progress: whether bars say how far it is.

    Returns:
        Mean absolute errors over J1 to J7 in degrees and over x, y, z in cm, of the filter, of the sensor's mean, and
        of the last targets taken for the joints; and the share of the true state in the filter's 90 % intervals.
    """
    whole = _sequences(UR5ExperienceReplay(demos, split="test", cache=cache, progress=progress))
    readings = read_demos(model, whole)
    generator = torch.Generator().manual_seed(0)
    readings["observed"] = torch.rand(*readings.shape, 1, generator=generator) >= missing
    out = _believe(behind_sensor(model), readings)
    truth = out["state"]
    estimates: Sequence[tuple[str, Tensor]] = [
        ("filter", out["belief", "mean"]),
        ("sensor", readings["sensor", "ensemble"].mean(-2)),
    ]
    rows: dict[str, dict[str, float]] = {}
    targets = readings["action"][:, :-1] - truth[:, 1:, :JOINTS]
    rows["last targets"] = {"joints, deg": float(targets.abs().mean().rad2deg())}
    for name, mean in estimates:
        error = (mean - truth).abs().mean((0, 1))
        rows[name] = {
            "joints, deg": float(error[:JOINTS].mean().rad2deg()),
            "tool, cm": 100 * float(error[JOINTS:].mean()),
        }
    parts = (out["belief", "mean"], out["belief", "var"], truth)
    covered = interval_coverage(*(part.flatten(0, 1) for part in parts), level=0.9)
    return {**rows, "held by 90 % intervals": float(covered.mean()), "demos": len(truth)}
