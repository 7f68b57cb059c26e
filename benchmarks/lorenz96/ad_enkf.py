r"""AD-EnKF on Lorenz-96: the forcing and the model noise learned from observations alone, without any true state.

The system has 40 variables, forcing F = 8 and Gaussian model noise N(0, 0.2^2) after every step of 0.05 time units.
The filter knows the equations but starts from F = 5 (a system that is hardly chaotic) and, if it is learned, a
model noise of 1. The loss is the negative log-likelihood of the innovations of an ensemble Kalman filter
with perturbed observations, back-propagated through the filter, and truncated every few steps
(:meth:`torch_denkf.objectives.DEnKFLoss.ad_enkf`). Windows of the record start from their first observation.

    python -m benchmarks.lorenz96 ad_enkf       # the table of benchmarks/lorenz96/results/ad_enkf.md

Source: Chen, Sanz-Alonso, Willett, "Autodifferentiable ensemble Kalman filters", SIAM J. Math. Data Sci. 4, 2022,
arXiv:2107.07687.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from math import log
from pathlib import Path

import torch

from benchmarks.common.arguments import made_by
from benchmarks.common.tables import head, line, write_page
from benchmarks.lorenz96.learned import (
    FORCING,
    NOISE,
    NOISE_START,
    START,
    R,
    climate_of,
    evaluate,
    forcing_of,
    learn,
    make_filter,
    noise_of,
    observe,
    simulate,
)

VARIABLES = 40
KEYS = ("observed", "taper", "learned", "seed")


@dataclass(frozen=True)
class Case:
    """A group of rows of the table."""

    every: int  # one variable in so many is observed
    radius: float | None  # of the taper
    learn_noise: bool

    @property
    def name(self) -> str:
        """Returns the observed variables, the taper's radius and the learned parameters."""
        observed = "all" if self.every == 1 else f"1 in {self.every}"
        return f"{observed} | {self.radius or 'none'} | {'F, Q' if self.learn_noise else 'F'}"


CASES = [Case(1, None, False), Case(1, 5.0, False), Case(1, 5.0, True), Case(2, 5.0, False), Case(2, 5.0, True)]


def run(case: Case, seed: int, variables: int, steps: int, updates: int, ensemble_size: int) -> tuple[str, float]:
    """Learns from one record; returns the row of the table, and the final error of F in per cent."""
    rng = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    record = observe(simulate(variables, steps, 1, rng), case.every, rng)
    setting = {"climate": climate_of(record), "radius": case.radius, "learn_noise": case.learn_noise}
    denkf = make_filter(variables, case.every, ensemble_size, **setting)
    unseen = simulate(variables, 300, 4, rng)
    unseen_record, scores = observe(unseen, case.every, rng), []
    scores.append(evaluate(denkf, unseen, unseen_record, 50))
    began = time.perf_counter()
    learn(denkf, record, updates, rng)
    elapsed, forcing = time.perf_counter() - began, forcing_of(denkf).item()
    scores.append(evaluate(denkf, unseen, unseen_record, 50))
    noise = noise_of(denkf)
    with torch.no_grad():  # last, because the true F and Q overwrite the learned ones
        forcing_of(denkf).fill_(FORCING)
        denkf["transition"].module["noise"].log_variance.fill_(2 * log(NOISE))
    scores.append(evaluate(denkf, unseen, unseen_record, 50))
    spread = f"{noise.mean():.3f} ({noise.min():.3f} to {noise.max():.3f})" if case.learn_noise else "given"
    start, end, known = scores
    error = 100 * (forcing / FORCING - 1)
    scores = f"{start:.2f}", f"{end:.3f}", f"{known:.3f}"
    return line(case.name, seed, f"{forcing:.3f}", f"{error:+.1f} %", spread, *scores, f"{elapsed:.0f}"), error


@dataclass
class ADEnKF:
    """Learns Lorenz-96's forcing and model noise from observations alone."""

    seeds: int = 3  # number of records, each for one training
    updates: int = 150  # of Adam
    steps: int = 2000  # of a record
    ensemble: int = 50  # members
    out: Path = Path("benchmarks/lorenz96/results/ad_enkf.md")
    smoke: bool = False  # a few updates on a short record, nothing written

    def __call__(self) -> None:
        """Learns in all cases and writes the page."""
        if self.smoke:
            self.seeds, self.updates, self.steps, self.ensemble = 1, 3, 100, 20
        began, rows, errors = time.perf_counter(), [], []
        for case in CASES:
            for seed in range(self.seeds):
                row, error = run(case, seed, VARIABLES, self.steps, self.updates, self.ensemble)
                rows.append(row), errors.append(error)
                print(row, flush=True)
        text = page(self, rows, errors, time.perf_counter() - began)
        write_page(text, None if self.smoke else self.out)


def page(options: ADEnKF, rows: list[str], errors: list[float], seconds: float) -> str:
    """Returns the page of results."""
    lines = [
        "# AD-EnKF: Lorenz-96's forcing from observations alone",
        "",
        f"{VARIABLES} variables, F = {FORCING:g}, model noise N(0, {NOISE:g}² I) a step of 0.05 time units, R = "
        f"{R**2:g} I, one record of {options.steps} steps a seed. Learning starts at F = {START:g}, and at a model "
        f"noise of {NOISE_START:g} where it is learned (Q: one variance for each variable), and sees no true state. "
        f"E = {options.ensemble}, windows of 40 steps after 20 of warm-up, 8 a batch, gradients cut every 10 steps, "
        "Adam.",
        "",
        "Taper: radius of Gaspari & Cohn's function. Noise: learned standard deviation, "
        f"mean over the variables and range; {NOISE:g} is true. RMSE: of the belief's mean on 4 unseen records of 300 "
        "steps without the first 50, before and after learning, and with the true F and Q in the same filter.",
        "",
        *head(*KEYS, "F", "error", "noise", "RMSE at first", "learned", "true F, Q", "s"),
        *rows,
        "",
        f"Largest error of F: {max(map(abs, errors)):.2f} %; mean of the errors, with their signs: "
        f"{sum(errors) / len(errors):+.2f} %.",
        "",
        f"* Seeds: 0 to {options.seeds - 1}, of record, windows and noise; none left out; single precision.",
        *made_by("lorenz96", f", {seconds:.0f} s"),
    ]
    return "\n".join(lines) + "\n"
