"""Compares filters on readings of which one in five is an outlier: options, rows and page."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import NormalDist

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.optim.lr_scheduler import CosineAnnealingLR

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.descent import minimise
from benchmarks.common.tables import head, line, pick, records, report, write_table
from benchmarks.outliers.filters import UPDATES, known, learned, lstm
from benchmarks.outliers.task import SHARE, SKIP, best, recordings
from torch_denkf import Filter
from torch_denkf.functional.scores import crps_gaussian
from torch_denkf.objectives import DEnKFLoss, GaussianLoss

SCALE = [0.02, 0.1]  # m, m/s: about the posterior standard deviation of the optimal filter
HALF = NormalDist().inv_cdf(0.95)
SCORES = ("rmse_x", "rmse_v", "crps_x", "crps_v", "held")
HEADS = ("RMSE, position", "RMSE, speed", "CRPS, position", "CRPS, speed")
KEYS = ("model", "filter", "update", "draw")


@dataclass(frozen=True)
class Study:
    """Options of the study of outliers."""

    out: Path | None = None  # folder for outliers.csv and outliers.md; existing rows are kept
    runs: int = 100  # test runs
    particles: int = 100_000  # of the reference, a particle filter with the true model
    training: int = 500  # training runs
    draws: int = 5  # seeds of an ensemble filter
    trainings: int = 5  # seeds of a trained filter
    updates: tuple[int, int] = (100, 700)  # training updates of the ensemble filter, and of the LSTM
    smoke: bool = False  # a short check: two runs, two updates


def scores(error: Tensor, crps: Tensor, held: Tensor) -> dict[str, float]:
    """Returns RMSE and CRPS of position (m) and speed (m/s), and the coverage of the 90 % intervals."""
    error, crps, held = (value[:, SKIP:].flatten(0, 1) for value in (error, crps, held))
    values = (*error.square().mean(0).sqrt(), *crps.mean(0), held.float().mean())
    return {name: float(value) for name, value in zip(SCORES, values, strict=True)}


@torch.no_grad()
def score(filter: Filter, data: TensorDict, draw: int) -> dict[str, float]:
    """Returns the scores of a filter's mean and variance, and the milliseconds of a step of all runs."""
    torch.manual_seed(draw)
    began = time.process_time()
    belief = filter.sequence(data.clone(), keep=[("belief", "mean"), ("belief", "var")])["belief"]
    took, error = time.process_time() - began, belief["mean"] - data["state"]
    crps = crps_gaussian(belief["mean"], belief["var"], data["state"])
    return {**scores(error, crps, error.abs() < HALF * belief["var"].sqrt()), "ms": 1e3 * took / data.shape[1]}


def fit(filter: Filter, loss: nn.Module, updates: int, rate: float, data: tuple) -> Filter:
    """Trains on whole runs, and keeps the parameters with the least validation error."""
    train, validation = data
    least, kept, every = float("inf"), filter.state_dict(), max(1, updates // 7)

    def batch_loss() -> Tensor:
        return sum(loss(train[torch.randint(len(train), (min(50, len(train)),))]).values())

    def validate(update: int) -> None:
        nonlocal least, kept
        if update % every == 0 or update == updates:
            with torch.random.fork_rng():
                found = score(filter, validation, 0)
            error = found["crps_x"] / SCALE[0] + found["crps_v"] / SCALE[1]
            if error < least:
                least, kept = error, {name: value.clone() for name, value in filter.state_dict().items()}

    cosine = partial(CosineAnnealingLR, T_max=updates)
    minimise(filter.parameters(), batch_loss, updates, rate, schedule=cosine, clip=1.0, after=validate)
    filter.load_state_dict(kept)
    return filter


def trained(kind: str, study: Study, draw: int, data: tuple) -> Filter:
    """Returns a trained filter."""
    torch.manual_seed(draw)
    if kind == "LSTM":
        filter, loss = lstm(), partial(GaussianLoss, score="crps")
    else:
        filter, loss = learned(), partial(DEnKFLoss, sensor=0.0)
    objective = loss(filter, transition=0.0, state_scale=SCALE)
    return fit(filter, objective, study.updates[kind == "LSTM"], 3e-3 if kind == "LSTM" else 1e-2, data)


def planned(study: Study, test: TensorDict) -> dict[tuple, Callable[[], dict]]:
    """Returns the function that computes each row, by model, filter, update and seed."""
    told = test.clone().set("sound", torch.full((*test.shape, 1), 1 - SHARE))
    training = recordings(study.training, 100), recordings(study.training // 2, 101)
    jobs: dict[tuple, Callable[[], dict]] = {
        ("", "truth", "", 0): lambda: scores(*best(test, study.particles).values())
    }
    for kind in ("EKF", "UKF", "DEnKF"):
        for update, around in UPDATES.items():
            for draw in range(study.draws if kind == "DEnKF" else 1):
                jobs["known", kind, update, draw] = lambda kind=kind, around=around, draw=draw: score(
                    around(known(kind)), told, draw
                )
    for draw in range(study.trainings):
        for kind, update in (("DEnKF", "`Contaminated`, trained"), ("LSTM", "")):
            jobs["learned", kind, update, draw] = lambda kind=kind, draw=draw: score(
                trained(kind, study, draw, training), test, draw
            )
    return jobs


def page(rows: list[dict], study: Study) -> str:
    """Returns the page."""
    (truth,) = pick(rows, filter="truth")
    lines = [
        "# A cart whose position readings have 20 % outliers",
        "",
        "RMSE and CRPS are ratios to those of a particle filter with the true model and "
        f"{study.particles:,} particles ({truth['rmse_x']:.3f} m and {truth['rmse_v']:.3f} m/s; {truth['crps_x']:.3f} "
        f"m and {truth['crps_v']:.3f} m/s; coverage {truth['held']:.0%}). {study.runs} runs of 2 s. Rows with several "
        "seeds give the mean and the range. Ensembles have 32 members.",
        "",
        *head("model", "filter", "update", *HEADS, "coverage", "ms", "seeds"),
    ]
    for name in dict.fromkeys((row["model"], row["filter"], row["update"]) for row in rows if row["model"]):
        own = [row for row in rows if (row["model"], row["filter"], row["update"]) == name]
        cells = [span([row[key] / truth[key] for row in own], "{:.2f}") for key in SCORES[:4]]
        held = span([100 * row["held"] for row in own], "{:.0f}")
        lines.append(line(*name, *cells, f"{held} %", f"{own[0]['ms']:.1f}", len(own)))
    lines += ["", "ms: processor time of a step of all runs, one thread.", "", *made_by("outliers")]
    return "\n".join(lines) + "\n"


def span(values: list[float], layout: str) -> str:
    """Returns the mean of values and their range, as text."""
    low, high, mean = (layout.format(value) for value in (min(values), max(values), sum(values) / len(values)))
    return mean if low == high else f"{mean} ({low} to {high})"


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, out=None, runs=2, particles=500, training=4, draws=1, trainings=1, updates=(2, 2))
    torch.set_num_threads(1)
    file = None if study.out is None else study.out / "outliers.csv"
    found = [] if file is None else records(file)
    rows = [{**dict.fromkeys(KEYS, ""), **row} for row in found]  # empty cells are missing from the read rows
    there = {tuple(row[key] for key in KEYS) for row in rows}
    for name, job in planned(study, recordings(study.runs, 0)).items():
        if name not in there:
            rows.append({**dict(zip(KEYS, name, strict=True)), **job()})
            print(rows[-1], flush=True)
            if file is not None:
                write_table(rows, file, KEYS)
    report(study.out, rows, page(rows, study), "outliers", KEYS)
