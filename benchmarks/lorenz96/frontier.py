"""Error against milliseconds per step on Lorenz-96: ensemble filters of many sizes, EKF, UKF, particle filter.

The standard set-up of :mod:`benchmarks.lorenz96.schemes`: 40 variables, all observed with unit variance, no model
noise. All filters know the equations and R. Validation records choose one setting of each filter and size: the
inflation and the radius of the localisation of an ensemble filter, the inflation of a Gaussian filter, the width of the
particle filter's jitter kernel.

    python -m benchmarks.lorenz96 frontier      # benchmarks/lorenz96/results/frontier.{md,csv,png}
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path

import torch
from tensordict import TensorDict

from benchmarks.common.arguments import made_by
from benchmarks.common.jobs import once, read_rows
from benchmarks.common.plots import draw_frontier
from benchmarks.common.scores import processor_ms
from benchmarks.common.tables import head, line, write_page, write_table
from benchmarks.lorenz96.learned import FORCING, Lorenz96, evaluate, tapers
from benchmarks.lorenz96.schemes import VARIABLES, simulate
from torch_denkf.filters import EKF, UKF, DEnKF, Filter, ParticleFilter
from torch_denkf.modules import (
    AroundState,
    ConstantNoise,
    EnsembleAnalysis,
    GaussianAround,
    GaussianLikelihood,
    LearnedTransition,
    LocalEnsembleAnalysis,
    Select,
)

TIMED, RUNS = 50, 10  # timed steps of one record, and repetitions
DIMS = list(range(VARIABLES))
FEW = 32  # largest localised ensemble: larger ones do not need it, and their local systems take seconds
ROTATED = 128  # largest etkf: the rotation of more members takes longer than the step

INFLATIONS, RADII = (1.0, 1.01, 1.02, 1.04, 1.07, 1.12), (4.0, 8.0, None)
GAUSSIAN_INFLATIONS = (1.02, 1.05, 1.1, 1.2, 1.3, 1.5)
KERNELS = (0.25, 0.5, 1.0, 2.0)
SCHEMES = {"DEnKF, stochastic": "perturbed", "DEnKF, etkf": "etkf", "DEnKF, sakov": "sakov"}
SHOWN = 2.0  # a filter with a larger error has diverged: the readings' error is 1
Make = Callable[[], Filter]


def _models() -> dict:
    transition = LearnedTransition(Lorenz96(FORCING), residual=False)
    noise = ConstantNoise([1.0] * VARIABLES, in_key="observation")
    return {"transition": transition, "sensor": None, "observation": Select(DIMS), "noise": noise}


def ensemble(scheme: str, size: int, radius: float | None, inflation: float) -> Filter:
    """Returns the DEnKF with one of the schemes; a localised ``"etkf"`` is the LETKF."""
    keys = {"inflation": inflation, "rotate": scheme == "etkf", "observation_key": "observation"}
    if scheme == "etkf" and radius is not None:
        places = torch.arange(float(VARIABLES)).unsqueeze(-1)
        analysis = LocalEnsembleAnalysis.around(places, places, radius, period=[float(VARIABLES)], **keys)
    else:
        taper = None if radius is None else tapers(DIMS, VARIABLES, radius)
        analysis = EnsembleAnalysis(scheme, taper=taper, **keys)
    return DEnKF(**_models(), analysis=analysis, initial=AroundState([1.0] * VARIABLES, ensemble_size=size))


def gaussian(kind: type[EKF | UKF], inflation: float) -> Filter:
    """Returns an extended or unscented Kalman filter."""
    keys = {"observation_key": "observation", "inflation": inflation, "process_noise": 0.0}
    return kind(**_models(), initial=GaussianAround([1.0] * VARIABLES), **keys)


def particles(size: int, kernel: float) -> Filter:
    """Returns a regularised bootstrap filter."""
    initial = AroundState([1.0] * VARIABLES, ensemble_size=size)
    likelihood = GaussianLikelihood(observation_key="observation")
    return ParticleFilter(**_models(), likelihood=likelihood, jitter=kernel, initial=initial)


def candidates(sizes: Iterable[int]) -> dict[tuple[str, int], dict[str, Make]]:
    """Returns filters by name and size, and their settings."""
    found: dict[tuple[str, int], dict[str, Make]] = {}
    for (name, scheme), size in product(SCHEMES.items(), sizes):
        if scheme == "etkf" and size > ROTATED:
            continue
        grid = product(RADII if size <= FEW else (None,), INFLATIONS)
        found[name, size] = {
            f"radius {r or 'none'}, inflation {i}": partial(ensemble, scheme, size, r, i) for r, i in grid
        }
    for kind in (EKF, UKF):
        found[kind.__name__, 1] = {f"inflation {i}": partial(gaussian, kind, i) for i in GAUSSIAN_INFLATIONS}
    for size in sizes:
        found["particle filter", size] = {f"kernel {width}": partial(particles, size, width) for width in KERNELS}
    return found


def row_of(name: str, size: int, settings: dict[str, Make], data: dict[str, TensorDict], skip: int, chunk: int) -> dict:
    """Chooses a setting on the validation records, and returns its error on the test records and its time."""
    scores = {}
    for setting, make in settings.items():
        torch.manual_seed(0)
        error = evaluate(make(), data["validation"]["state"], data["validation"], skip)
        scores[setting] = error if error == error else float("inf")
    best = min(scores, key=scores.__getitem__)
    torch.manual_seed(1)
    filter, one = settings[best](), data["test"][:1, :TIMED]
    row = {"filter": name, "members": size, "setting": best, "validation_rmse": scores[best]}
    row["rmse"] = evaluate(filter, data["test"]["state"], data["test"], skip)
    for column, steps in (("eager_ms_per_step", 0), ("ms_per_step", chunk)):
        filter.compile(chunk=steps)
        row[column] = processor_ms(lambda: filter.sequence(one.copy()), TIMED, RUNS)
    return row


def _rows(*arguments) -> list[dict]:
    return [row_of(*arguments, chunk=1)]


@dataclass
class Frontier:
    """Measures error and milliseconds per step: ensemble filters of many sizes, EKF, UKF, particle filter."""

    sizes: tuple[int, ...] = (8, 16, 32, 64, 128, 256, 512, 1024)  # members
    records: int = 4  # for validation, and as many for the test
    steps: int = 600  # of each
    burn_in: int = 100  # first steps, which are not scored
    out: Path = Path("benchmarks/lorenz96/results/frontier.md")
    rows: Path = Path("runs/lorenz96-frontier")  # an interrupted run resumes from here
    smoke: bool = False  # one size on short records, nothing compiled, nothing written

    def __call__(self) -> None:
        """Writes the page, the rows and the plot."""
        if self.smoke:
            self.sizes, self.records, self.steps, self.burn_in = (8,), 1, 10, 5
        began = time.perf_counter()
        truth, observations = (part.float().transpose(0, 1) for part in simulate(2 * self.records, self.steps))
        data = TensorDict({"state": truth, "observation": observations}, batch_size=truth.shape[:2])
        roles = dict(zip(("validation", "test"), data.split(self.records), strict=True))
        rows = []
        for (name, size), settings in candidates(self.sizes).items():
            if self.smoke:
                rows.append(row_of(name, size, dict(list(settings.items())[:1]), roles, self.burn_in, 0))
            else:
                file = self.rows / f"{name}-{size}-{self.records}-{self.steps}-{self.burn_in}.json"
                once(file, partial(_rows, name, size, settings, roles, self.burn_in))
                rows += read_rows([file])
            print(line(*(f"{v:.3g}" if isinstance(v, float) else v for v in rows[-1].values())), flush=True)
        write_page(self._page(rows, time.perf_counter() - began), None if self.smoke else self.out)
        if not self.smoke:
            write_table(rows, self.out.with_suffix(".csv"), ("filter", "members"))
            label = "root mean square error of the belief's mean"
            draw_frontier(rows, self.out.with_suffix(".png"), error="rmse", label=label, limit=SHOWN)

    def _page(self, rows: list[dict], seconds: float) -> str:
        lines = [
            "# Lorenz-96: error against milliseconds per step",
            "",
            f"{VARIABLES} variables, all observed with R = 1, no model noise, steps of 0.05 time units; all "
            f"filters know the equations and R, and begin around the truth with a standard deviation of 1. The "
            f"setting is chosen on {self.records} validation records; the RMSE is taken on {self.records} others "
            f"of {self.steps} steps without the first {self.burn_in}. The readings' own RMSE is 1. ms: processor "
            f"time, one record, one thread, the least of {RUNS} runs of {TIMED} steps, each step compiled.",
            "",
            *head("filter", "members", "setting", "RMSE, validation", "RMSE", "ms per step", "ms, not compiled"),
        ]
        for row in rows:
            numbers = (f"{row[k]:.3f}" for k in ("validation_rmse", "rmse", "ms_per_step", "eager_ms_per_step"))
            lines.append(line(row["filter"], row["members"], row["setting"], *numbers))
        lines += [
            "",
            "![RMSE against milliseconds per step](frontier.png)",
            "",
            *made_by("lorenz96", f", {seconds:.0f} s"),
        ]
        return "\n".join(lines) + "\n"
