"""A million steps of every filter's packaged step, with long stretches in which nothing is observed."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from tests.filters.factories import linear_denkf, linear_kalman, linear_system
from tests.filters.gaussian_for_tests import linear_filter
from tests.filters.particle_for_tests import bootstrap
from torch_denkf.baselines import LSTMFilter
from torch_denkf.deployment import export_step, load_step
from torch_denkf.deployment.package import PackagedStep
from torch_denkf.filters import Filter
from torch_denkf.modules import GaussianPrior

EVERY, STRETCH = 100_000, 10_000  # steps from one stretch without readings to the next, and its length
CHUNK = 10_000
SETTLE = 2_000  # steps after which a start is forgotten
COMPARED = 100  # steps without readings, and as many with them, that the filter itself takes, too


def _ensemble(scheme: str) -> Filter:
    return linear_denkf(scheme, noisy=True, initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=32))


#: Filters that draw nothing at random, and others.
EXACT: dict[str, Callable[[], Filter]] = {
    "KalmanFilter": linear_kalman,
    **{name: partial(linear_filter, name) for name in ("EKF", "UKF", "BackpropKF")},
    "LSTMFilter": partial(LSTMFilter, None, observation_dim=2, state_dim=2, observation_key="observation"),
}
SAMPLED: dict[str, Callable[[], Filter]] = {
    **{f"DEnKF, {scheme}": partial(_ensemble, scheme) for scheme in ("perturbed", "etkf", "sakov")},
    **{
        f"ParticleFilter, {resampling}": partial(bootstrap, 32, resampling=resampling)
        for resampling in ("systematic", "soft", "transport")
    },
}


class System:
    """The truth and its readings, chunk by chunk; a chunk follows from its number alone."""

    def __init__(self):
        self.F, Q, self.H, R = linear_system()
        self.root, self.std = torch.linalg.cholesky(Q), R.sqrt()

    def chunk(self, number: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """States, readings, and whether they arrive: NaN where not."""
        random = torch.Generator().manual_seed(number)
        state, states = torch.zeros(2), []
        noise = torch.randn(CHUNK, 2, generator=random) @ self.root.mT
        for step in noise:  # each chunk starts at zero: the system forgets in some dozens of steps
            state = self.F @ state + step
            states.append(state)
        truth = torch.stack(states)
        reading = truth @ self.H.mT + self.std * torch.randn(CHUNK, 2, generator=random)
        time_ = number * CHUNK + torch.arange(CHUNK)
        observed = (time_ % EVERY >= STRETCH).unsqueeze(-1)
        return truth, torch.where(observed, reading, torch.nan), observed


def memory() -> int:
    """The process's resident memory, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


class Run:
    """Steps of a package, and what is looked at."""

    def __init__(self, step: PackagedStep, start: dict[str, torch.Tensor]):
        self.step, self.carry = step, start
        self.not_finite = 0
        self.taken = 0.0

    def chunk(self, readings: torch.Tensor, observed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Means and variances, ``[CHUNK, 2]``."""
        means, variances, carry, step = [], [], self.carry, self.step
        began = time.perf_counter()
        for reading, seen in zip(readings.unbind(0), observed.unbind(0), strict=True):
            carry = step({**carry, "observation": reading, "observed": seen})
            means.append(carry["belief.mean"])
            variances.append(carry["belief.var"])
        self.taken += time.perf_counter() - began
        self.carry = {name: carry[name] for name in step.carry}
        mean, variance = torch.stack(means), torch.stack(variances)
        self.not_finite += int((~(mean.isfinite() & variance.isfinite() & (variance >= 0))).any(-1).sum())
        return mean, variance


def _start(step: PackagedStep, filter: Filter) -> dict[str, torch.Tensor]:
    begun = filter.initialise(TensorDict({"observation": torch.zeros(2)}))
    return {name: begun[tuple(name.split("."))].clone() for name in step.carry}


def differs(step: PackagedStep, filter: Filter, readings: torch.Tensor, observed: torch.Tensor) -> float:
    """Largest difference of a package's means and variances from those of the filter itself, step by step."""
    row, off = filter.initialise(TensorDict({"observation": torch.zeros(2)})), 0.0
    for reading, seen in zip(readings.unbind(0), observed.unbind(0), strict=True):
        row["observation"], row["observed"] = reading, seen
        found = step({name: row[tuple(name.split("."))] for name in step.inputs})
        row = filter.step(row)
        off = max(off, *(float((found[f"belief.{key}"] - row["belief", key]).abs().max()) for key in ("mean", "var")))
    return off


def soak(name: str, steps: int) -> dict[str, Any]:
    """A row of the table."""
    make, exact = (EXACT | SAMPLED)[name], name in EXACT
    torch.manual_seed(0)
    filter, system = make(), System()
    frame = TensorDict({"observation": torch.zeros(2), "observed": torch.ones(1, dtype=torch.bool)})
    chunks = steps // CHUNK
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        step = load_step(export_step(filter, frame, Path(folder) / "step.pt2"))
        blind, seeing = system.chunk(0)[1:], system.chunk(STRETCH // CHUNK)[1:]
        both = [torch.cat([one[-COMPARED:], other[:COMPARED]]) for one, other in zip(blind, seeing, strict=True)]
        mistake = differs(step, filter, *both) if exact else 0.0
        run, held = Run(step, _start(step, filter)), 0
        errors, spreads, unobserved = [], [], 0
        for number in range(chunks):
            truth, readings, observed = system.chunk(number)
            if number == chunks - 1:
                torch.manual_seed(1)
            mean, variance = run.chunk(readings, observed)
            seen = observed.squeeze(-1)
            unobserved += int((~seen).sum())
            if seen.all():
                errors.append(float((mean - truth)[SETTLE:].square().mean()))
                spreads.append(float(variance[SETTLE:].mean()))
            if number == max(chunks // 10, 1):
                held = memory()
        grown = memory() - held
        # The last chunk again, by a filter that starts there, under the same random numbers.
        torch.manual_seed(1)
        fresh = Run(step, _start(step, filter))
        again, _ = fresh.chunk(readings, observed)
    off = float((again - mean)[SETTLE:].abs().max())
    first, last = errors[0], errors[-1]
    alike = off < 1e-4 if exact else abs(float((again - truth)[SETTLE:].square().mean()) / last - 1) < 0.1
    right = mistake < 1e-5 and run.not_finite == 0 and grown < 16 << 20 and alike and abs(last / first - 1) < 0.25
    return {
        "steps": chunks * CHUNK,
        "unobserved": unobserved,
        "not finite": run.not_finite,
        "mean squared error, first chunk": first,
        "mean squared error, last chunk": last,
        "mean variance, first chunk": spreads[0],
        "mean variance, last chunk": spreads[-1],
        **({"largest difference from the filter": mistake} if exact else {}),
        "largest difference from a fresh run": off,
        "memory grown, MB": round(grown / 1e6, 2),
        "us a step": round(1e6 * run.taken / (chunks * CHUNK), 1),
        "right": right,
    }


def jobs(steps: int) -> dict[str, Callable[[], dict[str, Any]]]:
    """So many steps of each filter."""
    return {name: partial(soak, name, steps) for name in EXACT | SAMPLED}
