"""The study: its options, rows, and page."""

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

SCALE = [0.02, 0.1]  # m, m/s: about the standard deviation of what is known at best
HALF = NormalDist().inv_cdf(0.95)
SCORES = ("rmse_x", "rmse_v", "crps_x", "crps_v", "held")
KEYS = ("model", "filter", "update", "draw")


@dataclass(frozen=True)
class Study:
    """One reading in five is wrong: which filter copes?"""

    out: Path | None = None  # folder for outliers.csv and outliers.md; rows that are there stay
    runs: int = 100  # of the test
    particles: int = 100_000  # of what can be known at best
    training: int = 500  # runs to learn from
    draws: int = 5  # of ensembles
    trainings: int = 5
    updates: tuple[int, int] = (100, 700)  # of the ensemble, and of the LSTM
    smoke: bool = False  # two runs, two updates: does it run?


def scores(error: Tensor, crps: Tensor, held: Tensor) -> dict[str, float]:
    """Root mean square errors and CRPS of position, m, and speed, m/s; share held by the 90 % intervals."""
    error, crps, held = (value[:, SKIP:].flatten(0, 1) for value in (error, crps, held))
    values = (*error.square().mean(0).sqrt(), *crps.mean(0), held.float().mean())
    return {name: float(value) for name, value in zip(SCORES, values, strict=True)}


@torch.no_grad()
def score(filter: Filter, data: TensorDict, draw: int) -> dict[str, float]:
    """The scores of a filter as a Gaussian, and milliseconds a step of all runs."""
    torch.manual_seed(draw)
    began = time.process_time()
    belief = filter.sequence(data.clone(), keep=[("belief", "mean"), ("belief", "var")])["belief"]
    took, error = time.process_time() - began, belief["mean"] - data["state"]
    crps = crps_gaussian(belief["mean"], belief["var"], data["state"])
    return {**scores(error, crps, error.abs() < HALF * belief["var"].sqrt()), "ms": 1e3 * took / data.shape[1]}


def fit(filter: Filter, loss: nn.Module, updates: int, rate: float, data: tuple) -> Filter:
    """Trains on windows of whole runs; validation data choose the update that is kept."""
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
    """A learned filter."""
    torch.manual_seed(draw)
    if kind == "LSTM":
        filter, loss = lstm(), partial(GaussianLoss, score="crps")
    else:
        filter, loss = learned(), partial(DEnKFLoss, sensor=0.0)
    objective = loss(filter, transition=0.0, state_scale=SCALE)
    return fit(filter, objective, study.updates[kind == "LSTM"], 3e-3 if kind == "LSTM" else 1e-2, data)


def planned(study: Study, test: TensorDict) -> dict[tuple, Callable[[], dict]]:
    """Yields what makes each row, by model, filter, update and draw."""
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
    """The table."""
    (truth,) = pick(rows, filter="truth")
    lines = [
        "# A cart, one of five of whose positions is read wrongly",
        "",
        f"Errors and CRPS over those of {study.particles:,} particles with the true model ({truth['rmse_x']:.3f} m and "
        f"{truth['rmse_v']:.3f} m/s; {truth['crps_x']:.3f} m and {truth['crps_v']:.3f} m/s; {truth['held']:.0%} held). "
        f"{study.runs} runs of 2 s. What draws: mean, and range, of the draws. Ensembles have 32 members.",
        "",
        *head("model", "filter", "update", "RMSE, position", "speed", "CRPS, position", "speed", "held", "ms", "draws"),
    ]
    for name in dict.fromkeys((row["model"], row["filter"], row["update"]) for row in rows if row["model"]):
        own = [row for row in rows if (row["model"], row["filter"], row["update"]) == name]
        cells = [span([row[key] / truth[key] for row in own], "{:.2f}") for key in SCORES[:4]]
        held = span([100 * row["held"] for row in own], "{:.0f}")
        lines.append(line(*name, *cells, f"{held} %", f"{own[0]['ms']:.1f}", len(own)))
    lines += ["", "ms: processor time of a step of all runs, one thread.", "", *made_by("outliers")]
    return "\n".join(lines) + "\n"


def span(values: list[float], layout: str) -> str:
    """The mean of draws, and from where to where they go."""
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
    rows = [{**dict.fromkeys(KEYS, ""), **row} for row in found]  # what is empty is not read
    there = {tuple(row[key] for key in KEYS) for row in rows}
    for name, job in planned(study, recordings(study.runs, 0)).items():
        if name not in there:
            rows.append({**dict(zip(KEYS, name, strict=True)), **job()})
            print(rows[-1], flush=True)
            if file is not None:
                write_table(rows, file, KEYS)
    report(study.out, rows, page(rows, study), "outliers", KEYS)
