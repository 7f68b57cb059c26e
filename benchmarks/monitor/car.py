"""The car's task: alarms, gates and paths on drives whose camera fails."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import fmean

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.monitor.drives import ALWAYS, FAULTS, believed_spans, car_filter, failing, filtered
from benchmarks.monitor.scores import Run, afterwards, detection, false_alarms
from torch_denkf.filters import Filter, Gated
from torch_denkf.metrics import interval_coverage, kitti_endpoint_error
from torch_denkf.modules import InnovationMonitor, MonitoredSensor
from torch_denkf.odometry.car import VELOCITIES

__all__ = ["clean_rows", "drive_rows", "gate_of", "monitor_of", "path_scores"]

GATE = {"response": "reject", "window": 3, "rate": 1e-4, "patience": 30, "by_component": True}
MARGIN = 1.3  # on what the clean drives show: they are few
OTHER_KIND = 2.0  # that of a gate whose clean drives are of another kind: rendered ones, for real frames


def monitor_of(clean: Sequence[TensorDict]) -> InnovationMonitor:
    """A monitor, calibrated on beliefs of clean drives."""
    sensor = MonitoredSensor("info", 2, ("forecast", "observed"), noise_key=("sensor", "noise"))
    return InnovationMonitor({"camera": sensor}, window=3, reference=1.5).calibrate(clean, margin=MARGIN)


def gate_of(model: Filter, clean: Sequence[TensorDict], margin: float = MARGIN) -> Filter:
    """A gated filter, calibrated on clean drives' beliefs, which have what the gates saw."""
    gated = Gated(model, 2, **GATE)
    for gate in gated.gates:
        gate.calibrate(clean, margin=margin)
    return gated


def path_scores(beliefs: TensorDict) -> dict[str, float]:
    """End point error over 100 steps, and what the 90 % intervals hold, of draws ``[K, N]``."""
    window = min(100, beliefs.shape[1] - 1)
    ends = [
        float(kitti_endpoint_error(mean[:, :3].double(), truth[:, :3].double(), window=window).translation)
        for mean, truth in zip(beliefs["belief", "mean"], beliefs["state"], strict=True)
    ]
    parts = (beliefs["belief", "mean"], beliefs["belief", "var"].clamp_min(1e-9), beliefs["state"])
    held = interval_coverage(*(part[:, 1:, VELOCITIES].flatten(0, 1).double() for part in parts), level=0.9)
    return {"m_per_m": fmean(ends), "held_v": float(held[0]), "held_theta_dot": float(held[1])}


def drive_rows(
    task: str, root: Path, drives: Sequence[str], validation: Sequence[TensorDict], cache: Path, draws: int
) -> list[dict]:
    """A row for each fault, over all drives.

    Args:
        task: ``"kitti-real"``, of whose drives each one's thresholds come from the others, too, because they are
            another kind of picture than the rendered validation drives; or ``"kitti-rendered"``.
        root: folder in KITTI's layout.
        drives: names.
        validation: clean readings of drives that are in no test.
        cache: folder of readings.
        draws: of the filter's noise.
    """
    car, model = car_filter()
    unit = car.settings.unit
    # Beliefs of a gate that does nothing: those of the filter, with what the gate saw.
    watching = Gated(model, 2, **{**GATE, "rate": 0.0})
    clean = [failing(root, name, "clean", cache) for name in drives]
    others = filtered(watching, validation)
    own = filtered(watching, clean, draws)
    if task == "kitti-real":
        known = [[*others, *own[:place], *own[place + 1 :]] for place in range(len(drives))]
        tools = [(monitor_of(each), gate_of(model, each, OTHER_KIND)) for each in known]
    else:
        tools = [(monitor_of(others), gate_of(model, others))] * len(drives)
    runs = [run for (monitor, _), belief in zip(tools, own, strict=True) for run in runs_of(monitor, belief)]
    alarms = false_alarms(runs)
    gated_clean = answered_by(tools, clean, draws)
    rows = [{"task": task, "fault": "none", **alarms, **compared(own, gated_clean)}]
    for fault in FAULTS:
        runs, errors, sound = [], [], []
        readings = [failing(root, name, fault, cache) for name in drives]
        beliefs, answered = filtered(model, readings, draws), answered_by(tools, readings, draws)
        for place, reading in enumerate(readings):
            hit = reading["fault"].squeeze(-1)
            if hit.any():
                runs += runs_of(tools[place][0], beliefs[place])
                errors.append(afterwards(velocity_error(answered[place], unit), hit).flatten())
                sound.append(afterwards(velocity_error(gated_clean[place], unit), hit).flatten())
        ratio = float(torch.cat(errors).mean() / torch.cat(sound).mean())
        rows.append({"task": task, "fault": fault, **detection(runs), **alarms, "error_ratio": ratio})
    for fault in ALWAYS if task == "kitti-real" else ("box-all",):
        readings = [failing(root, name, fault, cache) for name in drives]
        plain = filtered(model, readings, draws)
        if fault == "black-all":  # what the monitor does not believe is read again, over a longer span
            for place, (monitor, _) in enumerate(tools):
                longer = [failing(root, drives[place], fault, cache, steps) for steps in (2, 3)]
                doubt = partial(doubted, model, monitor)
                readings[place] = believed_spans([readings[place], *longer], doubt)
        rows.append({"task": task, "fault": fault, **compared(plain, answered_by(tools, readings, draws))})
    return rows


def answered_by(
    tools: Sequence[tuple[InnovationMonitor, Filter]], readings: Sequence[TensorDict], draws: int
) -> list[TensorDict]:
    """Beliefs of the gated filters, each on its drive."""
    first = tools[0][1]
    if all(gate is first for _, gate in tools):
        return filtered(first, readings, draws)
    return [filtered(gate, [each], draws)[0] for (_, gate), each in zip(tools, readings, strict=True)]


def clean_rows(
    task: str, root: Path, drives: Sequence[str], validation: Sequence[TensorDict], cache: Path, draws: int
) -> list[dict]:
    """Path scores of drives without faults, one row; thresholds from the validation drives alone."""
    _, model = car_filter()
    gate = gate_of(model, filtered(Gated(model, 2, **{**GATE, "rate": 0.0}), validation))
    readings = [failing(root, name, "clean", cache) for name in drives]
    scores = compared(filtered(model, readings, draws), filtered(gate, readings, draws))
    return [{"task": task, "fault": "none", **scores}]


def compared(plain: Sequence[TensorDict], gated: Sequence[TensorDict]) -> dict[str, float]:
    """Path scores of the filter and of the gated one, means over the drives of at least 100 steps."""
    out: dict[str, float] = {}
    for suffix, beliefs in (("", plain), ("_gated", gated)):
        scores = [path_scores(each) for each in beliefs if each.shape[1] > 100] or [path_scores(beliefs[0])]
        out |= {name + suffix: fmean(score[name] for score in scores) for name in scores[0]}
    return out


def runs_of(monitor: InnovationMonitor, beliefs: TensorDict) -> list[Run]:
    """What a monitor says of beliefs ``[K, N]``."""
    said = monitor.replay(beliefs)["monitor"]
    parts = (said["camera", "evidence"], said["alarm"], beliefs["fault"])
    return [Run(*row) for row in zip(*(part.squeeze(-1) for part in parts), strict=True)]


def velocity_error(beliefs: TensorDict, unit: Tensor) -> Tensor:
    """Error of speed and turn rate in units of a good sensor's, ``[K, N]``."""
    return ((beliefs["belief", "mean"] - beliefs["state"])[..., VELOCITIES].abs() / unit).mean(-1)


@torch.no_grad()
def doubted(model: Filter, monitor: InnovationMonitor, reading: TensorDict) -> Tensor:
    """Whether the sensor claims more noise of a reading than it ever does on clean data, ``[N]``."""
    noise = model["noise"](reading.copy())["sensor", "noise"]
    return (monitor.claim_score("camera", noise) > monitor.claim_limit[0]).squeeze(-1)
