"""The car's task: alarms, gates and paths on drives whose camera fails."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.monitor.drives import ALWAYS, FAULTS, SIGNS, believed_spans, car_filter, failing, filtered, side_by_side
from benchmarks.monitor.scores import Run, afterwards, detection, false_alarms
from torch_denkf.applications.car.metrics.odometry import kitti_endpoint_error
from torch_denkf.applications.car.odometry.filter import VELOCITIES
from torch_denkf.applications.car.vision.poses import KITTI_DT
from torch_denkf.applications.car.vision.signs import FLOW_SIGNS, PICTURE_SIGNS
from torch_denkf.metrics import interval_coverage
from torch_denkf.monitoring import InnovationMonitor, MonitoredSensor, SignGate

#: Floors of the limits: half of an image may be sun or shadow, brightness may rise by two thirds, 1 % may be a smear.
FLOOR = (0.01, 0.5, 0.5, 0.5, 0.0, 0.0)
PICTURES = len(PICTURE_SIGNS)
BLIND = slice(1, PICTURES)  # signs that reject an image: not the first, as flow in static regions is extrapolated
MOVING = 2.0  # m/s: lower speeds are not used to estimate the scale


@dataclass(frozen=True)
class CarGuard:
    """Settings that are chosen on validation drives, see :mod:`benchmarks.monitor.choice`.

    Attributes:
        rate: share of the clean readings whose speed is taken from the flow, because it contradicts the road.
        margin: factor on the monitor's limits.
        reference: of its cumulative sum.
    """

    rate: float = 0.1
    margin: float = 2.0
    reference: float = 2.0


CHOSEN = CarGuard()


class CarGates(NamedTuple):
    """Responses to signs.

    Attributes:
        pictures: rejects readings by the signs of their images.
        flow: detects readings that the flow contradicts.
        scale: factor from the distance by the flow to that of the sensor.
    """

    pictures: SignGate
    flow: SignGate
    scale: float

    def seen(self, reading: TensorDict) -> Tensor:
        """Returns the observed mask after rejection by the images' signs, ``[N, 1]``."""
        signs = TensorDict({"signs": reading["signs"][:, BLIND], "observed": reading["observed"]}, [len(reading)])
        return self.pictures(signs)["seen"]

    def answered(self, reading: TensorDict) -> TensorDict:
        """Returns the readings without those that their images' signs reject.

        If the flow contradicts the road, the speed is that of the flow.
        """
        out, signs = reading.copy().set("observed", self.seen(reading)), reading["signs"]
        second = ~self.flow(TensorDict({"signs": signs[:, PICTURES:]}, [len(signs)]))["seen"]
        second = second & ~reading["plane"].isnan()
        ensemble = reading["sensor", "ensemble"].clone()
        speed = self.scale * reading["plane"] / KITTI_DT
        ensemble[..., 0] += torch.where(second, speed - ensemble[..., 0].mean(-1, keepdim=True), 0.0)
        return out.set("sensor", reading["sensor"].copy().set("ensemble", ensemble))


def monitor_of(beliefs: Sequence[TensorDict], guard: CarGuard = CHOSEN) -> InnovationMonitor:
    """Returns a monitor, calibrated on beliefs of clean drives."""
    sensor = MonitoredSensor(
        "info", 2, ("forecast", "observed"), ("sensor", "noise"), sign_key="signs", signs=len(SIGNS), floor=FLOOR
    )
    monitor = InnovationMonitor({"camera": sensor}, window=3, reference=guard.reference)
    return monitor.calibrate(side_by_side(beliefs), margin=guard.margin)


def gates_of(readings: Sequence[TensorDict], guard: CarGuard = CHOSEN) -> CarGates:
    """Returns the gates, calibrated on clean readings."""
    signs = [TensorDict({"signs": each["signs"][1:]}, [len(each) - 1]) for each in readings]
    pictures = SignGate(PICTURES - 1, rate=1e-3, floor=FLOOR[BLIND])
    pictures.calibrate([TensorDict({"signs": each["signs"][:, BLIND]}, each.batch_size) for each in signs])
    flow = SignGate(len(FLOW_SIGNS), rate=guard.rate)
    flow.calibrate([TensorDict({"signs": each["signs"][:, PICTURES:]}, each.batch_size) for each in signs])
    plane = torch.cat([each["plane"][1:, 0] for each in readings]) / KITTI_DT
    read = torch.cat([each["sensor", "ensemble"][1:, :, 0].mean(-1) for each in readings])
    moving = plane > MOVING
    return CarGates(pictures, flow, float((read[moving] / plane[moving]).median()))


def path_scores(beliefs: TensorDict) -> dict[str, float]:
    """Returns end-point error over 100 steps and 90 % coverage of draws ``[K, N]``."""
    window = min(100, beliefs.shape[1] - 1)
    ends = [
        float(kitti_endpoint_error(mean[:, :3].double(), truth[:, :3].double(), window=window).translation)
        for mean, truth in zip(beliefs["belief", "mean"], beliefs["state"], strict=True)
    ]
    parts = (beliefs["belief", "mean"], beliefs["belief", "var"].clamp_min(1e-9), beliefs["state"])
    held = interval_coverage(*(part[:, 1:, VELOCITIES].flatten(0, 1).double() for part in parts), level=0.9)
    return {"m_per_m": fmean(ends), "held_v": float(held[0]), "held_theta_dot": float(held[1])}


def drive_rows(
    task: str, root: Path, drives: Sequence[str], calibration: Sequence[TensorDict], cache: Path, draws: int
) -> list[dict]:
    """Returns a row for each fault, over all drives.

    Args:
        task: ``"kitti-rendered"``; or ``"kitti-real"``, with gates of each drive calibrated on the other real drives,
            because real images differ from rendered ones, and monitors on both.
        root: folder in KITTI's layout.
        drives: names.
        calibration: clean readings of rendered drives that are in no test.
        cache: folder of readings.
        draws: of the filter's noise.
    """
    car, model = car_filter()
    unit = car.settings.unit
    clean = [failing(root, name, "clean", cache, repair=True) for name in drives]
    own, known = filtered(model, clean, draws), filtered(model, calibration)
    if task == "kitti-real" and len(drives) > 1:
        rest = [[*range(place), *range(place + 1, len(drives))] for place in range(len(drives))]
        monitors = [monitor_of([*known, *(own[k] for k in others)]) for others in rest]
        gates = [gates_of([clean[k] for k in others]) for others in rest]
    else:
        monitors, gates = [monitor_of(known)] * len(drives), [gates_of(calibration)] * len(drives)

    def answered(readings: Sequence[TensorDict]) -> list[TensorDict]:
        pairs = zip(gates, readings, strict=True)
        return filtered(model, [each.answered(reading) for each, reading in pairs], draws)

    sound = answered(clean)
    alarms = false_alarms([run for each, belief in zip(monitors, own, strict=True) for run in runs_of(each, belief)])
    rows = [{"task": task, "fault": "none", **alarms, **compared(own, sound)}]
    for fault in FAULTS:
        runs, after, before = [], [], []
        readings = [failing(root, name, fault, cache) for name in drives]
        beliefs = filtered(model, readings, draws)
        guarded = answered([failing(root, name, fault, cache, repair=True) for name in drives])
        for place, reading in enumerate(readings):
            hit = reading["fault"].squeeze(-1)
            if hit.any():
                runs += runs_of(monitors[place], beliefs[place])
                after.append(afterwards(velocity_error(guarded[place], unit), hit).flatten())
                before.append(afterwards(velocity_error(sound[place], unit), hit).flatten())
        ratio = float(torch.cat(after).mean() / torch.cat(before).mean())
        rows.append({"task": task, "fault": fault, **detection(runs), **alarms, "error_ratio": ratio})
    for fault in ALWAYS if task == "kitti-real" else ("box-all",):
        plain = filtered(model, [failing(root, name, fault, cache) for name in drives], draws)
        readings = [failing(root, name, fault, cache, repair=True) for name in drives]
        if fault == "black-all":  # rejected readings are replaced by those over a longer span
            for place, each in enumerate(gates):
                longer = [failing(root, drives[place], fault, cache, steps) for steps in (2, 3)]
                readings[place] = believed_spans([readings[place], *longer], each.seen)
            guarded = filtered(model, readings, draws)
        else:
            guarded = answered(readings)
        rows.append({"task": task, "fault": fault, **compared(plain, guarded)})
    return rows


def compared(plain: Sequence[TensorDict], gated: Sequence[TensorDict]) -> dict[str, float]:
    """Returns path scores of the filter and of the gated filter, means over the drives of at least 100 steps."""
    out: dict[str, float] = {}
    for suffix, beliefs in (("", plain), ("_gated", gated)):
        scores = [path_scores(each) for each in beliefs if each.shape[1] > 100] or [path_scores(beliefs[0])]
        out |= {name + suffix: fmean(score[name] for score in scores) for name in scores[0]}
    return out


def runs_of(monitor: InnovationMonitor, beliefs: TensorDict) -> list[Run]:
    """Returns the monitor's output on beliefs ``[K, N]``."""
    said = monitor.replay(beliefs)["monitor"]
    parts = (said["camera", "evidence"], said["alarm"], beliefs["fault"])
    return [Run(*row) for row in zip(*(part.squeeze(-1) for part in parts), strict=True)]


def velocity_error(beliefs: TensorDict, unit: Tensor) -> Tensor:
    """Returns the error of speed and turn rate in units of a good sensor's, ``[K, N]``."""
    return ((beliefs["belief", "mean"] - beliefs["state"])[..., VELOCITIES].abs() / unit).mean(-1)
