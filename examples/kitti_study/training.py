"""The stages of a fold: sensor alone, filter on the frozen sensor's readings, then both end to end."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor, nn

from kitti_study.filters import FILTERS, SENSORS, VELOCITIES, Statistics, analysis_of, parts_of
from kitti_study.fold import Fold, FrameSampler, Part, ReadingSampler, statistics, take_spans
from kitti_study.streams import LONGEST, MISSING, mirror, rows, spans
from torch_denkf.data import steps_between
from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble
from torch_denkf.metrics import interval_coverage
from torch_denkf.modules import SubModel
from torch_denkf.objectives import DEnKFLoss
from torch_denkf.training import FilterTrainer, Stage, read_checkpoint, write_checkpoint


@dataclass(frozen=True)
class Budget:
    """Updates of each stage; steps of the filter's windows."""

    sensor: int = 1500
    fine_tuning: int = 300  # of a sensor that comes trained on rendered drives
    filter: int = 300
    end_to_end: int = 40
    length: int = 24
    gain_error: float = 0.02  # of the sensor's speed on a new drive, as the filter is to expect it


class SensorLoss(nn.Module):
    """CRPS of the sensor's samples against the true velocities, in units of a good sensor's errors."""

    def __init__(self, sensor: SubModel, unit: Tensor):
        super().__init__()
        self.sensor = sensor
        self.register_buffer("unit", unit)

    def forward(self, frames: TensorDict) -> dict[str, Tensor]:
        """Scores frames ``[N]``; the terms are losses of v and of theta_dot."""
        samples = self.sensor(frames)["sensor", "ensemble"]
        score = crps_ensemble(samples, frames["target_observation"]) / self.unit
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


def read_spans(sensor: SubModel, part: Part, cache: Path, kind: str, mirrored: bool = False) -> TensorDict:
    """A sensor's readings of a part ``[N]``, of pairs of 1, 2, ... steps: ``("spans", ...)`` ``[N, LONGEST]``.

    Those that were not computed are not observed.
    """
    parts = [replace(part, stream=stream) for stream in spans(part.stream, kind)]
    read = [read_sensor(sensor, each.read(cache), kind, mirrored) for each in parts]
    entries = {
        "observed": [each["observed"] for each in read],
        "ensemble": [each["sensor", "ensemble"] for each in read],
        "encoding": [each["sensor", "encoding"] for each in read],
    }
    blank = LONGEST - len(read)
    stacked = {
        key: torch.stack([*values, *[torch.zeros_like(values[0])] * blank], 1) for key, values in entries.items()
    }
    size = (len(read[0]), LONGEST)
    return TensorDict({"state": read[0]["state"], "spans": TensorDict(stacked, batch_size=size)}, batch_size=size[:1])


def lose_frames(readings: TensorDict, seed: int, share: float = MISSING) -> TensorDict:
    """What the sensor reads where some frames did not arrive: pairs of those that did."""
    kept = torch.rand(len(readings), generator=torch.Generator().manual_seed(seed)) >= share
    return take_spans(readings, steps_between(kept, LONGEST))


def all_frames(readings: TensorDict) -> TensorDict:
    """What the sensor reads of neighbours."""
    return take_spans(readings, torch.ones(len(readings), dtype=torch.int64))


@torch.no_grad()
def run_filter(model: Filter, readings: Sequence[TensorDict]) -> TensorDict:
    """Filters readings of one length side by side, ``[K, N]``, each from its true first state."""
    batch = torch.stack([reading.copy() for reading in readings])
    batch["is_init"] = torch.zeros(*batch.batch_size, 1, dtype=torch.bool)
    batch["is_init"][:, 0] = True
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        return parts_of(model, sensor=False).sequence(batch)


def velocity_crps(samples: Tensor, frames: TensorDict, unit: Tensor) -> Tensor:
    """CRPS of (v, theta_dot) ``[*B]``, mean of both in units of a good sensor's errors."""
    return (crps_ensemble(samples, frames["state"][..., VELOCITIES]) / unit).mean(-1)


def sensor_error(sensor: SubModel, parts: Sequence[Part], cache: Path, kind: str, unit: Tensor) -> dict[str, float]:
    """CRPS of a sensor where it observes."""
    readings = [read_sensor(sensor, part.read(cache), kind) for part in parts]
    scores = [velocity_crps(r["sensor", "ensemble"], r, unit)[r["observed"].squeeze(-1)].mean() for r in readings]
    return {"crps": float(torch.stack(scores).mean())}


def run_all(model: Filter, readings: Sequence[TensorDict]) -> list[TensorDict]:
    """Filters each reading as it is and with missing frames; those of one length side by side, ``[K, N]``."""
    groups = defaultdict(list)
    for seed, reading in enumerate(readings):
        groups[len(reading)] += [all_frames(reading), lose_frames(reading, seed)]
    return [run_filter(model, group) for group in groups.values()]


def filter_error(model: Filter, readings: Sequence[TensorDict], unit: Tensor) -> dict[str, float]:
    """CRPS of the belief on each reading, as it is and with missing frames."""
    results = run_all(model, readings)
    scores = [velocity_crps(out["belief", "ensemble"][..., VELOCITIES], out, unit)[:, 1:].mean(-1) for out in results]
    return {"crps": float(torch.cat(scores).mean())}


def start_std_of(facts: Statistics) -> Tensor:
    """How wrong the first velocity of a training window is; its pose is right."""
    return torch.cat([torch.zeros(3), 0.2 * facts.scale])


def train_sensor(
    sensor: SubModel,
    parts: Sequence[Part],
    held_out: Sequence[Part],
    *,
    kind: str,
    facts: Statistics,
    out: Path,
    cache: Path,
    seed: int,
    updates: int,
    lr: float = 2e-3,
    keep: str = "best",
) -> SubModel:
    """Trains a sensor alone, or reads it where that was done before."""
    if (out / "sensor.pt").exists():
        sensor.load_state_dict(read_checkpoint(out / "sensor.pt")["sensor"])
        return sensor
    model, sampler = nn.ModuleDict({"sensor": sensor}), FrameSampler(parts, cache, kind)
    stage = Stage(
        "sensor",
        SensorLoss(sensor, facts.unit),
        lambda generator, _: sampler.frames(generator),
        updates,
        lr=lr,
        weight_decay=0.02,
    )
    FilterTrainer(
        model,
        [stage],
        out=out,
        validate=lambda: sensor_error(sensor, held_out, cache, kind, facts.unit),
        validate_every=max(updates // 4, 1),
        save_every=200,
        seed=seed,
        keep=keep,
    ).fit()
    write_checkpoint(out / "sensor.pt", {"sensor": sensor.state_dict()})
    return sensor


def unseen_readings(
    sensor: SubModel, fold: Fold, *, kind: str, facts: Statistics, out: Path, cache: Path, seed: int, updates: int
) -> list[tuple[TensorDict, TensorDict, float]]:
    """Readings of drives by sensors that have not seen them, also where drives are too few to set some aside.

    A filter learns from its sensor's errors, which are smaller on drives that the sensor was trained on. So drives that
    are in both lists are read by one of two sensors that stand in: each is trained on one half of those drives, and
    reads the other.

    Returns:
        for each part of the tuning drives, and mirrored: readings to tune with, readings to validate with, the weight.
    """
    shared = list(dict.fromkeys(p.stream.drive for p in fold.tune if p.stream.drive in fold.trained))
    readers = {}
    for half in (shared[0::2], shared[1::2]) if shared else ():
        stand_in = deepcopy(sensor)
        parts = [part for part in fold.train if part.stream.drive not in half]
        folder = out / ("without-" + "-".join(half))
        held_out = [part for part in fold.tune if part.stream.drive in half]
        settings = {"kind": kind, "facts": facts, "out": folder, "cache": cache, "seed": seed, "updates": updates}
        train_sensor(stand_in, parts, held_out, lr=1e-3, keep="last", **settings)
        readers |= dict.fromkeys(half, stand_in)
    result = []
    for part in fold.tune:
        reader = readers.get(part.stream.drive, sensor)
        for mirrored in (False, True):
            reading = read_spans(reader, part, cache, kind, mirrored)
            split = int(0.7 * len(reading))
            result.append((reading[:split], reading[split:], part.weight))
    return result


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
    common = {"kind": kind, "facts": facts, "cache": cache, "seed": seed}
    if pretrained is None:
        rates = {"updates": budget.sensor}
    else:
        sensor.load_state_dict(pretrained.state_dict())
        rates = {"updates": budget.fine_tuning, "lr": 1e-3, "keep": "last"}
    read = unseen_readings(sensor, fold, out=out, updates=budget.fine_tuning, **common) if fold.shared else []
    train_sensor(sensor, fold.train, fold.validation, out=out / "sensor", **common, **rates)
    read = read or unseen_readings(sensor, fold, out=out, updates=0, **common)

    model = FILTERS[filter_name](sensor, facts)
    start_std, frames = start_std_of(facts), FrameSampler(fold.train, cache, kind)
    windows = ReadingSampler(
        [tune for tune, _, _ in read], [weight for *_, weight in read], budget.length, budget.gain_error
    )
    validation = [reading for _, reading, _ in read[::2]]  # not the mirrored ones: they say the same
    # The pose follows from the velocities: it does not count.
    scale = torch.cat([torch.full((3,), torch.inf), facts.unit])
    recursion, whole = (parts_of(model, sensor=sensor, start_std=start_std) for sensor in (False, True))
    third = max(budget.end_to_end // 3, 1)
    stages = [
        Stage(
            "filter",
            DEnKFLoss(recursion, sensor=0.0, state_scale=scale),
            lambda generator, _: windows.windows(generator, start_std),
            budget.filter,
            lr=5e-3,
            validate=lambda: filter_error(model, validation, facts.unit),
        ),
        Stage(
            "end_to_end",
            DEnKFLoss(whole, sensor=1.0, state_scale=scale, observation_scale=facts.unit),
            lambda generator, length: frames.windows(generator, length, start_std),
            budget.end_to_end,
            # The noise model knows by now how wrong the sensor is on new drives; on those it has seen it would forget.
            parameters=[*sensor.parameters(), *model["transition"].parameters()],
            lr=1e-4,
            lengths={0: 4, third: 8, 2 * third: 16},
            validate=lambda: filter_error(
                model, [read_spans(sensor, part, cache, kind) for part in fold.validation], facts.unit
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
    calibrate(model, validation)
    save_settings(out, filter_name, kind, facts, analysis_of(model).inflation)
    return model, facts


def calibrate(model: Filter, readings: Sequence[TensorDict], level: float = 0.9) -> None:
    """Sets the inflation of the analysis with which the filter's intervals hold their share of the truth."""
    analysis, distance = analysis_of(model), {}
    for inflation in (1.0, 1.05, 1.1, 1.15, 1.2, 1.3, 1.4):
        analysis.inflation = inflation
        covered = torch.stack([_coverage(out, level) for out in run_all(model, readings)]).mean(0)
        distance[inflation] = float((covered - level).abs().sum())
    analysis.inflation = min(distance, key=distance.get)


def _coverage(out: TensorDict, level: float) -> Tensor:
    mean, variance, truth = out["belief", "mean"], out["belief", "var"], out["state"]
    pairs = [value[:, 1:, VELOCITIES].flatten(0, 1) for value in (mean, variance, truth)]
    return interval_coverage(*pairs, level=level)


def save_settings(folder: Path, filter_name: str, kind: str, facts: Statistics, inflation: float) -> None:
    """Leaves beside the checkpoints what :func:`load_filter` needs to build the filter anew."""
    folder.mkdir(parents=True, exist_ok=True)
    numbers = {key: value.tolist() if isinstance(value, Tensor) else value for key, value in asdict(facts).items()}
    (folder / "filter.json").write_text(
        json.dumps({"filter": filter_name, "sensor": kind, "inflation": inflation, "statistics": numbers})
    )


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
    analysis_of(model).inflation = settings["inflation"]
    return model, facts, settings["filter"], settings["sensor"]
