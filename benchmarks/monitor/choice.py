"""Chooses the study's settings on drives and demos that are in no test."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from statistics import fmean
from typing import Any

from tensordict import TensorDict

from benchmarks.monitor.arm import ArmGuard, Beliefs, arm_monitor, demo_runs, gated_errors
from benchmarks.monitor.car import CarGuard, gates_of, monitor_of, path_scores, runs_of
from benchmarks.monitor.drives import FAULTS, car_filter, filtered, side_by_side
from benchmarks.monitor.scores import detection, false_alarms

RATES = (0.005, 0.02, 0.05, 0.1, 0.15, 0.2)
MARGINS = (1.0, 1.3, 1.6, 2.0)
REFERENCES = (1.0, 1.5, 2.0)
ALARM_RATES = (1e-3, 1e-2, 3e-2)  # of the arm's monitor; the margin makes them rarer
FALSE_ALARMS = 0.5  # in 1,000 steps: half of the target, because test data differ


def choose_car(
    calibration: Sequence[TensorDict], validation: dict[str, Sequence[TensorDict]], draws: int
) -> tuple[CarGuard, list[dict]]:
    """Chooses the rate of the gate, then margin and reference of the monitor.

    Args:
        calibration: clean readings of synthetic drives.
        validation: readings of other synthetic drives by fault, including ``"clean"`` and ``"box-all, repaired"``.
        draws: of the filter's noise.

    Returns:
        The chosen settings, and a row for each trial.
    """
    _, model = car_filter()
    guard, rows = CarGuard(), []
    known = filtered(model, calibration)

    def guarded(readings: Sequence[TensorDict], guard: CarGuard, left_out: bool = False) -> list[dict[str, float]]:
        """Returns the path scores; with ``left_out``, each calibration drive has a gate from the other drives."""
        answered = []
        for place, reading in enumerate(readings):
            others = [each for k, each in enumerate(calibration) if not (left_out and k == place)]
            answered.append(gates_of(others, guard).answered(reading))
        return [path_scores(each) for each in filtered(model, answered, draws)]

    plain = _mean([path_scores(each) for each in filtered(model, [*calibration, *validation["clean"]], draws)])
    rows.append({"trial": "car: without a gate", **plain})
    for rate in RATES:
        trial = replace(guard, rate=rate)
        scores = [*guarded(calibration, trial, left_out=True), *guarded(validation["clean"], trial)]
        rows.append({"trial": "car: gate", "rate": rate, **_mean(scores)})
    guard = replace(guard, rate=min(rows[1:], key=lambda row: row["m_per_m"])["rate"])
    rows.append({"trial": "car: behind a box", **_mean(guarded(validation["box-all, repaired"], guard))})
    beliefs = {fault: side_by_side(filtered(model, validation[fault], draws)) for fault in ("clean", *FAULTS)}
    tried = []
    for reference in REFERENCES:
        for margin in MARGINS:
            monitor = monitor_of(known, replace(guard, margin=margin, reference=reference))
            runs = {fault: [run for each in part for run in runs_of(monitor, each)] for fault, part in beliefs.items()}
            tried.append({"trial": "car: monitor", "margin": margin, "reference": reference, **_alarms(runs, "clean")})
    best = _best(tried)
    return replace(guard, margin=best["margin"], reference=best["reference"]), [*rows, *tried]


def choose_arm(beliefs: Beliefs) -> tuple[ArmGuard, list[dict]]:
    """Chooses rate, margin and reference of the monitor, then the gate's margin."""
    rows, guard = [], ArmGuard()
    for rate, reference, margin in product(ALARM_RATES, REFERENCES, MARGINS[::2] + MARGINS[-1:]):
        trial = replace(guard, rate=rate, margin=margin, reference=reference)
        runs = demo_runs(arm_monitor(beliefs.clean, trial), beliefs.plain)
        setting = {"rate": rate, "margin": margin, "reference": reference}
        rows.append({"trial": "arm: monitor", **setting, **_alarms(runs, "none")})
    best = _best(rows)
    guard = replace(guard, rate=best["rate"], margin=best["margin"], reference=best["reference"])
    tried = []
    for margin in MARGINS[::3]:
        trial = replace(guard, gate_margin=margin)
        errors = gated_errors(beliefs, trial)
        tried.append({"trial": "arm: gate", "margin": margin, **errors, "mean": fmean(errors.values())})
    return replace(guard, gate_margin=min(tried, key=lambda row: row["mean"])["margin"]), [*rows, *tried]


def _alarms(runs: dict[str, list], sound: str) -> dict[str, float]:
    """Returns false alarms on fault-free runs, and the worst AUROC and delay over the faults."""
    found = [detection(part) for fault, part in runs.items() if fault != sound]
    worst = {"auroc": min(each["auroc"] for each in found), "delay_steps": max(each["delay_steps"] for each in found)}
    return {**false_alarms(runs[sound]), **worst}


def _best(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Returns the monitor with the shortest delay, then best AUROC, among those with few enough false alarms."""
    quiet = [row for row in rows if row["false_alarms_per_1000"] <= FALSE_ALARMS]
    if not quiet:
        return min(rows, key=lambda row: row["false_alarms_per_1000"])
    return min(quiet, key=lambda row: (row["delay_steps"], -row["auroc"]))


def _mean(scores: Sequence[dict[str, float]]) -> dict[str, float]:
    return {key: fmean(score[key] for score in scores) for key in scores[0]}
