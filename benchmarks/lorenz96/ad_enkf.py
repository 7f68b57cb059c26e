r"""AD-EnKF on Lorenz-96: the forcing and the model noise learned from observations alone, without any true state.

The system has 40 variables, forcing F = 8 and Gaussian model noise N(0, 0.2^2) after every step of 0.05 time units.
The filter knows the equations but starts from F = 5 (a system that hardly is chaotic) and, where it is learned, a
model noise of 1. What is minimised is the negative log-likelihood of the innovations of an ensemble Kalman filter
with perturbed observations, back-propagated through the filter, cut every few steps
(:meth:`torch_denkf.objectives.DEnKFLoss.ad_enkf`). Windows of the record start from their first observation.

    python benchmarks/ad_enkf.py                # the table of benchmarks/results/ad_enkf.md

Source: Chen, Sanz-Alonso, Willett, "Autodifferentiable ensemble Kalman filters", SIAM J. Math. Data Sci. 4, 2022,
arXiv:2107.07687.
"""

from __future__ import annotations

import argparse
import platform
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import log
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import nn

from torch_denkf.data.lorenz96 import lorenz96_step
from torch_denkf.filters import DEnKF
from torch_denkf.functional import gaspari_cohn
from torch_denkf.modules import (
    ConstantNoise,
    EnsembleAnalysis,
    FromSensor,
    LearnedTransition,
    Select,
)
from torch_denkf.objectives import DEnKFLoss

FORCING, NOISE, R = 8.0, 0.2, 1.0  # of the true system: F; model noise and observation noise, standard deviations
START, NOISE_START = 5.0, 1.0  # where learning begins
SPIN_UP = 500  # steps from a random state to the attractor


@dataclass(frozen=True)
class Case:
    """A group of rows of the table."""

    every: int  # one variable in so many is observed
    radius: float | None  # of the taper
    learn_noise: bool

    @property
    def name(self) -> str:
        """What is observed, and what is learned."""
        observed = "all" if self.every == 1 else f"1 in {self.every}"
        return f"{observed} | {self.radius or 'none'} | {'F, Q' if self.learn_noise else 'F'}"


CASES = [
    Case(1, None, False),
    Case(1, 5.0, False),
    Case(1, 5.0, True),
    Case(2, 5.0, False),
    Case(2, 5.0, True),
]


class Lorenz96(nn.Module):
    """One step of the system for states ``[*, N]``; its only parameter is the forcing F."""

    def __init__(self, forcing: float) -> None:
        super().__init__()
        self.forcing = nn.Parameter(torch.tensor(forcing))

    def forward(self, state: torch.Tensor) -> torch.Tensor:
        """Returns the states 0.05 time units later."""
        return lorenz96_step(state, forcing=self.forcing)


def tapers(dims: Sequence[int], variables: int, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Factors on the covariances of the variables and the observed ones ``[N, O]``, and of the observed ``[O, O]``.

    With few members correlations of variables far apart are noise; AD-EnKF tapers them in gain and likelihood alike.

    Args:
        dims: the observed variables, of those on the circle.
        variables: N, on the circle.
        radius: distance at which correlations have fallen to 5/24; they are zero from twice that on.
    """
    observed, places = torch.as_tensor(dims), torch.arange(variables)
    return tuple(gaspari_cohn(on_circle(first, observed, variables), radius * 0.3**0.5) for first in (places, observed))


def on_circle(first: torch.Tensor, second: torch.Tensor, variables: int) -> torch.Tensor:
    """Distances ``[len(first), len(second)]`` between places on a circle."""
    distance = (first.unsqueeze(-1) - second).abs()
    return torch.minimum(distance, variables - distance)


def simulate(variables: int, steps: int, records: int, rng: torch.Generator) -> torch.Tensor:
    """True states ``[records, steps, variables]`` on the attractor."""
    state = FORCING + torch.randn(records, variables, generator=rng)
    states = []
    for _ in range(SPIN_UP + steps):
        state = lorenz96_step(state, forcing=FORCING) + NOISE * torch.randn(state.shape, generator=rng)
        states.append(state)
    return torch.stack(states[SPIN_UP:], 1)


def observe(states: torch.Tensor, every: int, rng: torch.Generator) -> TensorDict:
    """What the filter gets: ``observation`` ``[*B, T, variables / every]``, and nothing else."""
    seen = states[..., ::every]
    return TensorDict({"observation": seen + R * torch.randn(seen.shape, generator=rng)}, states.shape[:-1])


def make_filter(
    variables: int,
    every: int,
    ensemble_size: int,
    *,
    climate: tuple[float, float],
    radius: float | None,
    learn_noise: bool = False,
) -> DEnKF:
    """An ensemble Kalman filter of the system with a wrong forcing.

    Args:
        variables: N.
        every: one variable in so many is observed.
        ensemble_size: E.
        climate: mean and standard deviation of one variable, for those that are not observed at the start.
        radius: of the taper, see :func:`tapers`; ``None`` for none.
        learn_noise: whether the model noise is a parameter, one variance a variable, and wrong at first.
    """
    dims = list(range(0, variables, every))
    noise = ConstantNoise(
        [NOISE_START if learn_noise else NOISE] * variables,
        trainable=learn_noise,
        in_key=("belief", "ensemble"),
        out_key=("forecast", "noise"),
    )
    mean, std = climate
    taper = None if radius is None else tapers(dims, variables, radius)
    return DEnKF(
        transition=LearnedTransition(Lorenz96(START), residual=False),
        sensor=None,
        observation=Select(dims),
        noise=ConstantNoise([R] * len(dims), in_key="observation"),
        process_noise=noise,
        analysis=EnsembleAnalysis("perturbed", taper=taper, sensor_key="observation"),
        initial=FromSensor(
            dims, [mean] * variables, [std] * variables, ensemble_size=ensemble_size, sensor_key="observation"
        ),
    )


def climate_of(record: TensorDict) -> tuple[float, float]:
    """Mean and standard deviation of a variable, from observations: their variance is the system's plus R."""
    observation = record["observation"]
    return observation.mean().item(), (observation.var().item() - R**2) ** 0.5


def forcing_of(denkf: DEnKF) -> torch.Tensor:
    """The parameter F."""
    return denkf["transition"].module["transition"].module.forcing


def noise_of(denkf: DEnKF) -> torch.Tensor:
    """Standard deviation of the model noise of each variable."""
    return (0.5 * denkf["transition"].module["noise"].log_variance).exp().detach()


def learn(
    denkf: DEnKF,
    record: TensorDict,
    *,
    updates: int,
    rng: torch.Generator,
    batch: int = 8,
    warm_up: int = 20,
    window: int = 40,
    detach_every: int = 10,
    rate: float = 0.1,
) -> list[float]:
    """Maximises the likelihood on windows of the ``record`` ``[records, steps]``; returns F before and after updates.

    A window begins with the belief that the present filter has after ``warm_up`` steps from the window's first
    observation: the start knows less than the filter does later, and its likelihood says little about F. The choice
    of the windows is ``rng``'s, the noise of the filter torch's own.
    """
    loss = DEnKFLoss.ad_enkf(denkf, detach_every=detach_every)
    optimiser = torch.optim.Adam(denkf.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, updates, 0.01 * rate)
    path = [forcing_of(denkf).item()]
    for _ in range(updates):
        rows = torch.randint(record.shape[0], (batch,), generator=rng).tolist()
        starts = torch.randint(record.shape[1] - warm_up - window, (batch,), generator=rng).tolist()
        places = zip(rows, starts, strict=True)
        frames = torch.stack([record[row, start : start + warm_up + window + 1] for row, start in places])
        with torch.no_grad():
            warm = denkf.sequence(frames[:, : warm_up + 1].copy()).select(*denkf.belief_keys)
        frames = frames[:, warm_up:].copy()
        # A stored belief needs an entry for every time; only the first is read, as nothing starts anew in between.
        frames.update(warm[:, -1:].expand(batch, window + 1))
        total = loss(frames)["loss_nll"]
        optimiser.zero_grad()
        total.backward()
        nn.utils.clip_grad_norm_(denkf.parameters(), 10.0)
        optimiser.step()
        schedule.step()
        path.append(forcing_of(denkf).item())
    return path


@torch.no_grad()
def evaluate(denkf: DEnKF, states: torch.Tensor, record: TensorDict, skip: int) -> float:
    """Root mean square error of the belief's mean on an unseen record; here alone the true states are used."""
    mean = denkf.sequence(record.copy())["belief", "mean"]
    return (mean - states)[:, skip:].square().mean().sqrt().item()


def processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []:
        if line.startswith("model name"):
            return line.split(":")[1].strip()
    return platform.processor() or platform.machine()


def run(case: Case, seed: int, variables: int, steps: int, updates: int, ensemble_size: int) -> tuple[str, str, float]:
    """Learns from one record; the row of the table, the path of F, and its last error in per cent."""
    rng = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    record = observe(simulate(variables, steps, 1, rng), case.every, rng)
    setting = {"climate": climate_of(record), "radius": case.radius, "learn_noise": case.learn_noise}
    denkf = make_filter(variables, case.every, ensemble_size, **setting)
    unseen = simulate(variables, 300, 4, rng)
    unseen_record, scores = observe(unseen, case.every, rng), []
    scores.append(evaluate(denkf, unseen, unseen_record, 50))
    began = time.perf_counter()
    path = learn(denkf, record, updates=updates, rng=rng)
    elapsed = time.perf_counter() - began
    scores.append(evaluate(denkf, unseen, unseen_record, 50))
    noise = noise_of(denkf)
    with torch.no_grad():  # last, because it overwrites what was learned: the filter that knows the truth
        forcing_of(denkf).fill_(FORCING)
        denkf["transition"].module["noise"].log_variance.fill_(2 * log(NOISE))
    scores.append(evaluate(denkf, unseen, unseen_record, 50))
    spread = f"{noise.mean():.3f} ({noise.min():.3f} to {noise.max():.3f})" if case.learn_noise else "given"
    start, end, known = scores
    error = 100 * (path[-1] / FORCING - 1)
    row = (
        f"| {case.name} | {seed} | {path[-1]:.3f} | {error:+.1f} % | {spread} | {start:.2f} | "
        f"{end:.3f} | {known:.3f} | {elapsed:.0f} |"
    )
    every = max(1, updates // 10)
    values = " | ".join(f"{value:.2f}" for value in path[::every])
    return row, f"| {case.name} | {seed} | {values} |", error


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="records learned from, one after the other (default: 3)")
    parser.add_argument("--updates", type=int, default=150, help="of Adam (default: 150)")
    parser.add_argument("--steps", type=int, default=2000, help="of a record (default: 2000)")
    parser.add_argument("--ensemble", type=int, default=50, help="members (default: 50)")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/ad_enkf.md"))
    parser.add_argument("--smoke", action="store_true", help="a few updates on a short record, nothing written")
    args = parser.parse_args()
    torch.set_num_threads(1)  # on tensors this small more threads only wait for each other
    variables = 40
    if args.smoke:
        args.seeds, args.updates, args.steps, args.ensemble = 1, 3, 100, 20
    began, rows, paths, errors = time.perf_counter(), [], [], []
    for case in CASES:
        for seed in range(args.seeds):
            row, path, error = run(case, seed, variables, args.steps, args.updates, args.ensemble)
            rows.append(row), paths.append(path), errors.append(error)
            print(row, flush=True)
    shown = range(0, args.updates + 1, max(1, args.updates // 10))
    lines = [
        "# AD-EnKF: Lorenz-96's forcing from observations alone",
        "",
        f"{variables} variables, F = {FORCING:g}, model noise N(0, {NOISE:g}² I) a step of 0.05 time units, R = "
        f"{R**2:g} I, one record of {args.steps} steps a seed. Learning starts at F = {START:g}, and at a model noise "
        f"of {NOISE_START:g} where it is learned (Q: one variance for each variable), and sees no true state. "
        f"E = {args.ensemble}, windows of 40 steps after 20 of warm-up, 8 a batch, gradients cut every 10 steps, Adam.",
        "",
        "Taper: radius of Gaspari & Cohn's function. Noise: learned standard deviation, "
        f"mean over the variables and range; {NOISE:g} is true. RMSE: of the belief's mean on 4 unseen records of 300 "
        "steps without the first 50, before and after learning, and with the true F and Q in the same filter.",
        "",
        "| observed | taper | learned | seed | F | error | noise | RMSE at first | learned | true F, Q | s |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
        *rows,
        "",
        f"Largest error of F: {max(map(abs, errors)):.2f} %; mean of the errors, with their signs: "
        f"{sum(errors) / len(errors):+.2f} %.",
        "",
        "F after so many updates:",
        "",
        "| observed | taper | learned | seed | " + " | ".join(map(str, shown)) + " |",
        "|---" * (4 + len(shown)) + "|",
        *paths,
        "",
        f"* Command: `{shlex.join(['python', 'benchmarks/ad_enkf.py', *sys.argv[1:]])}`",
        f"* Seeds: 0 to {args.seeds - 1}, of record, windows and the filter's noise; none left out; single precision.",
        f"* Hardware: {processor()}, {torch.get_num_threads()} thread(s), shared; torch {torch.__version__}; "
        f"{time.perf_counter() - began:.0f} s in all.",
    ]
    if not args.smoke:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
