"""The stages of a fold: sensor alone, filter on the frozen sensor's readings, then both end to end."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from kitti_study.filters import FILTERS, SENSORS, VELOCITIES, Statistics, without_sensor
from kitti_study.fold import Fold, FrameSampler, Part, ReadingSampler, statistics
from kitti_study.streams import MISSING, mirror, rows
from torch_denkf.filters import DEnKF, Filter
from torch_denkf.functional import crps_ensemble
from torch_denkf.modules import AroundState, SubModel
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.training import FilterTrainer, Stage, read_checkpoint, write_checkpoint


@dataclass(frozen=True)
class Budget:
    """Updates of each stage; lengths of the windows."""

    sensor: int = 1500
    fine_tuning: int = 400  # of a sensor that comes trained on rendered drives
    filter: int = 300
    end_to_end: int = 60
    length: int = 24


class SensorLoss(nn.Module):
    """CRPS of the sensor's samples against the true velocities, in units of a good sensor's errors."""

    def __init__(self, sensor: SubModel, unit: Tensor):
        super().__init__()
        self.sensor = sensor
        self.register_buffer("unit", unit)

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """Scores frames ``[N]``; the terms are losses of v and of theta_dot."""
        samples = self.sensor(frames)["sensor", "ensemble"]
        score = crps_ensemble(samples, frames["state"][..., VELOCITIES]) / self.unit
        v, theta_dot = score[frames["observed"].squeeze(-1)].mean(0)
        return {"loss_v": v, "loss_theta_dot": theta_dot}


@torch.no_grad()
def read_sensor(sensor: SubModel, data: TensorDict, kind: str, mirrored: bool = False, chunk: int = 256) -> TensorDict:
    """A sensor's readings of a whole stream ``[N]``, from the same random numbers each time."""
    readings = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        was_training = sensor.training
        sensor.eval()
        for index in torch.arange(len(data)).split(chunk):
            frames = rows(data, index, kind)
            readings.append(sensor(mirror(frames) if mirrored else frames).exclude("flow", "road", "pixels"))
        sensor.train(was_training)
    return torch.cat(readings)


def lose_frames(reading: TensorDict, seed: int) -> TensorDict:
    """The same readings where some frames did not arrive; a reading needs its frame and the one before."""
    kept = torch.rand(len(reading) + 1, 1, generator=torch.Generator().manual_seed(seed)) >= MISSING
    return reading.copy().set("observed", reading["observed"] & kept[1:] & kept[:-1])


@torch.no_grad()
def run_filter(model: Filter, readings: Sequence[TensorDict]) -> TensorDict:
    """Filters readings of one length side by side, ``[K, N]``, each from its true first state."""
    batch = torch.stack([reading.copy() for reading in readings])
    batch["is_init"] = torch.zeros(*batch.batch_size, 1, dtype=torch.bool)
    batch["is_init"][:, 0] = True
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return without_sensor(model).sequence(batch)


class Validation:
    """Errors of sensor and filter on the validation drives, in units of a good sensor's errors."""

    def __init__(self, model: Filter, parts: Sequence[Part], cache: Path, kind: str, unit: Tensor):
        self.model, self.kind, self.unit = model, kind, unit
        self.data = [(part.stream.name, part.read(cache)) for part in parts]

    def sensor(self) -> Mapping[str, float]:
        """CRPS of the sensor where it observes."""
        scores = [self._score(r["sensor", "ensemble"], r)[r["observed"].squeeze(-1)].mean() for r in self._readings()]
        return {"crps": float(torch.stack(scores).mean())}

    def filter(self) -> Mapping[str, float]:
        """CRPS of the belief on every validation drive in every condition, and with missing frames."""
        scores = []
        for reading in self._readings():
            out = run_filter(self.model, [reading, lose_frames(reading, seed=len(scores))])
            scores.append(self._score(out["belief", "ensemble"][..., VELOCITIES], out)[:, 1:].mean())
        return {"crps": float(torch.stack(scores).mean())}

    def _readings(self) -> list[TensorDict]:
        return [read_sensor(self.model["sensor"], data, self.kind) for _, data in self.data]

    def _score(self, samples: Tensor, frames: TensorDict) -> Tensor:
        return crps_ensemble(samples, frames["state"][..., VELOCITIES]) / self.unit


def start_std_of(facts: Statistics) -> Tensor:
    """How wrong the first velocity of a training window is; its pose is right."""
    return torch.cat([torch.zeros(3), 0.2 * facts.scale])


def pretrain(
    kind: str, parts: Sequence[Part], held_out: Sequence[Part], out: Path, cache: Path, seed: int, updates: int
):
    """Trains a sensor on rendered drives, for all folds, or reads the one that is there."""
    torch.manual_seed(seed)
    facts = statistics(parts, cache)
    sensor = SENSORS[kind](facts)
    if (out / "sensor.pt").exists():
        sensor.load_state_dict(read_checkpoint(out / "sensor.pt")["sensor"])
        return sensor
    model = nn.ModuleDict({"sensor": sensor})
    sampler = FrameSampler(parts, cache, kind)
    stage = Stage(
        "sensor",
        SensorLoss(sensor, facts.unit),
        lambda generator, _: sampler.frames(generator),
        updates,
        weight_decay=0.02,
    )
    validation = Validation(model, held_out, cache, kind, facts.unit)
    trainer = FilterTrainer(
        model,
        [stage],
        out=out,
        validate=validation.sensor,
        validate_every=max(updates // 6, 1),
        save_every=200,
        seed=seed,
    )
    trainer.fit()
    write_checkpoint(out / "sensor.pt", {"sensor": sensor.state_dict()})
    return sensor


def train_fold(
    fold: Fold,
    filter_name: str,
    kind: str,
    *,
    out: Path,
    cache: Path,
    seed: int,
    budget: Budget,
    pretrained: SubModel | None = None,
    loggers: Sequence[str] = ("csv",),
) -> tuple[Filter, Statistics]:
    """Trains one filter on a fold, or goes on where it was broken off; the model at the end is the best one."""
    torch.manual_seed(seed)
    facts = statistics(fold.train, cache)
    sensor = SENSORS[kind](facts)
    if pretrained is not None:
        sensor.load_state_dict(pretrained.state_dict())
    model = FILTERS[filter_name](sensor, facts)
    start_std = start_std_of(facts)
    frames = FrameSampler(fold.train, cache, kind)
    readings: list[ReadingSampler] = []  # made when the sensor has been trained

    def reading_windows(generator: torch.Generator, length: int) -> TensorDict:
        if not readings:
            parts = [(part.read(cache), part.weight, mirrored) for part in fold.tune for mirrored in (False, True)]
            read = [read_sensor(model["sensor"], data, kind, mirrored) for data, _, mirrored in parts]
            readings.append(ReadingSampler(read, [weight for _, weight, _ in parts], length))
        return readings[0].windows(generator, start_std)

    # The pose follows from the velocities: it does not count. So does not the belief's first row.
    scale = torch.cat([torch.full((3,), torch.inf), facts.unit])
    recursion = without_sensor(model, start_std)
    whole = DEnKF(
        **{name: model[name] for name in ("transition", "sensor", "observation", "noise", "analysis")},
        initial=AroundState(start_std, ensemble_size=recursion.initial.ensemble_size, state_key="start"),
    )
    validation = Validation(model, fold.validation, cache, kind, facts.unit)
    stages = [
        Stage(
            "sensor",
            SensorLoss(sensor, facts.unit),
            lambda generator, _: frames.frames(generator),
            budget.sensor if pretrained is None else budget.fine_tuning,
            lr=2e-3 if pretrained is None else 1e-3,
            weight_decay=0.02,
            validate=validation.sensor,
        ),
        Stage(
            "filter",
            DEnKFLoss(recursion, sensor=0.0, state_scale=scale),
            reading_windows,
            budget.filter,
            lengths={0: budget.length},
        ),
        Stage(
            "end_to_end",
            DEnKFLoss(whole, sensor=1.0, state_scale=scale, observation_scale=facts.unit),
            lambda generator, length: frames.windows(generator, length, start_std),
            budget.end_to_end,
            lr=1e-4,
            lengths={0: 4, budget.end_to_end // 3 + 1: 8, 2 * budget.end_to_end // 3 + 2: 16},
        ),
    ]
    trainer = FilterTrainer(
        model,
        stages,
        out=out,
        validate=validation.filter,
        validate_every=max(budget.filter // 3, 1),
        save_every=200,
        loggers=loggers,
        seed=seed,
    )
    trainer.fit()
    save_settings(out, filter_name, kind, facts)
    return model, facts


def save_settings(folder: Path, filter_name: str, kind: str, facts: Statistics) -> None:
    """Leaves beside the checkpoints what :func:`load_filter` needs to build the filter anew."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = {key: value.tolist() if isinstance(value, Tensor) else value for key, value in asdict(facts).items()}
    (folder / "filter.json").write_text(json.dumps({"filter": filter_name, "sensor": kind, "statistics": numbers}))


def load_filter(folder: Path) -> tuple[Filter, Statistics, str, str]:
    """A trained filter, the statistics of its training drives, and the names of filter and sensor.

    Raises:
        FileNotFoundError: if no training was finished in the folder.
    """
    if not (folder / "filter.json").exists() or not (folder / "best_end_to_end.pt").exists():
        raise FileNotFoundError(f"no finished training in {folder}: it lacks filter.json or best_end_to_end.pt")
    settings = json.loads((folder / "filter.json").read_text())
    numbers = settings["statistics"]
    facts = Statistics(**{k: torch.tensor(v) if isinstance(v, list) else v for k, v in numbers.items()})
    model = FILTERS[settings["filter"]](SENSORS[settings["sensor"]](facts), facts)
    model.load_state_dict(read_checkpoint(folder / "best_end_to_end.pt")["model"])
    return model, facts, settings["filter"], settings["sensor"]
