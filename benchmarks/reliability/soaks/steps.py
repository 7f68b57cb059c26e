"""A million steps of every filter's packaged step, with long stretches of missing observations."""

from __future__ import annotations

import resource
import tempfile
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
SETTLE = 2_000  # steps after which the initial belief has no influence
COMPARED = 100  # steps without readings, and as many with them, that are compared with the filter itself


def _ensemble(scheme: str) -> Filter:
    return linear_denkf(scheme, noisy=True, initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=32))


#: Deterministic filters; those with random draws follow.
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


def drawn(number: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Returns states, readings (NaN for missing ones) and observed masks of a chunk, seeded by its number."""
    F, Q, H, R = linear_system()
    random = torch.Generator().manual_seed(number)
    state, states = torch.zeros(2), []
    for noise in torch.randn(CHUNK, 2, generator=random) @ torch.linalg.cholesky(Q).mT:
        state = F @ state + noise  # each chunk starts at zero: the system forgets in some dozens of steps
        states.append(state)
    truth = torch.stack(states)
    reading = truth @ H.mT + R.sqrt() * torch.randn(CHUNK, 2, generator=random)
    observed = ((number * CHUNK + torch.arange(CHUNK)) % EVERY >= STRETCH).unsqueeze(-1)
    return truth, torch.where(observed, reading, torch.nan), observed


def memory() -> int:
    """Returns the process's resident memory, bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


class Run:
    """Runs a packaged step from the filter's prior."""

    def __init__(self, step: PackagedStep, filter: Filter):
        begun = filter.initialise(TensorDict({"observation": torch.zeros(2)}))
        self.step, self.carry = step, {name: begun[tuple(name.split("."))].clone() for name in step.carry}

    def chunk(self, readings: torch.Tensor, observed: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Returns means and variances, ``[CHUNK, 2]``."""
        found = []
        for reading, seen in zip(readings.unbind(0), observed.unbind(0), strict=True):
            out = self.step({**self.carry, "observation": reading, "observed": seen})
            self.carry = {name: out[name] for name in self.step.carry}
            found.append(torch.stack([out["belief.mean"], out["belief.var"]]))
        mean, variance = torch.stack(found, 1)
        return mean, variance


def differs(step: PackagedStep, filter: Filter, readings: torch.Tensor, observed: torch.Tensor) -> float:
    """Returns the largest difference of means and variances between a packaged step and the filter's own."""
    row, off = filter.initialise(TensorDict({"observation": torch.zeros(2)})), 0.0
    for reading, seen in zip(readings.unbind(0), observed.unbind(0), strict=True):
        row["observation"], row["observed"] = reading, seen
        found = step({name: row[tuple(name.split("."))] for name in step.inputs})
        row = filter.step(row)
        off = max(off, *(float((found[f"belief.{key}"] - row["belief", key]).abs().max()) for key in ("mean", "var")))
    return off


def soak(name: str, steps: int) -> dict[str, Any]:
    """Returns a row of the table."""
    make, exact = (EXACT | SAMPLED)[name], name in EXACT
    torch.manual_seed(0)
    filter, chunks = make(), steps // CHUNK
    frame = TensorDict({"observation": torch.zeros(2), "observed": torch.ones(1, dtype=torch.bool)})
    with tempfile.TemporaryDirectory() as folder, torch.no_grad():
        step = load_step(export_step(filter, frame, Path(folder) / "step.pt2"))
        blind, seeing = drawn(0)[1:], drawn(STRETCH // CHUNK)[1:]
        both = [torch.cat([one[-COMPARED:], other[:COMPARED]]) for one, other in zip(blind, seeing, strict=True)]
        mistake = differs(step, filter, *both) if exact else 0.0
        run, held, errors, unobserved, not_finite = Run(step, filter), 0, [], 0, 0
        for number in range(chunks):
            truth, readings, observed = drawn(number)
            if number == chunks - 1:
                torch.manual_seed(1)
            mean, variance = run.chunk(readings, observed)
            not_finite += int((~(mean.isfinite() & variance.isfinite() & (variance >= 0))).any(-1).sum())
            unobserved += int((~observed).sum())
            errors += [float((mean - truth)[SETTLE:].square().mean())] if observed.all() else []
            if number == max(chunks // 10, 1):
                held = memory()
        grown = memory() - held
        # The last chunk again, by a filter that starts there, under the same random numbers.
        torch.manual_seed(1)
        again, _ = Run(step, filter).chunk(readings, observed)
    off = float((again - mean)[SETTLE:].abs().max())
    first, last = errors[0], errors[-1]
    alike = off < 1e-4 if exact else abs(float((again - truth)[SETTLE:].square().mean()) / last - 1) < 0.1
    right = mistake < 1e-5 and not_finite == 0 and grown < 16 << 20 and alike and abs(last / first - 1) < 0.25
    return {
        "steps": chunks * CHUNK,
        "unobserved": unobserved,
        "not finite": not_finite,
        "mean squared error, first chunk": first,
        "mean squared error, last chunk": last,
        **({"largest difference from the filter": mistake} if exact else {}),
        "largest difference from a fresh run": off,
        "memory grown, MB": round(grown / 1e6, 2),
        "right": right,
    }


def jobs(steps: int) -> dict[str, Callable[[], dict[str, Any]]]:
    """Returns jobs that run ``steps`` steps of each filter."""
    return {name: partial(soak, name, steps) for name in EXACT | SAMPLED}
