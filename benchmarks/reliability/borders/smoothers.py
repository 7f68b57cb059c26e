"""Smoothers: their constructors, and the recordings that they read."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability.borders import filters_fed as fed
from benchmarks.reliability.borders.filters_made import STDS, parts
from benchmarks.reliability.borders.subjects import Subject, cases_of
from benchmarks.reliability.case import Case
from benchmarks.reliability.damage import COUNT, MODULE, POSITIVE, finite, same
from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.filters import ParticleFilter
from torch_denkf.modules import GaussianLikelihood, LearnedTransition
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, IEnKS, ParticleSmoother, RTSSmoother

LAG = {what: value for what, value in COUNT.items() if what != "zero"}
FILTER: dict[str, Any] = {"nothing": None, "text": "x", "no filter": torch.nn.Linear(2, 2)}
DAMPING = {**POSITIVE, "beyond one": 1.5}


def still(members: int = 8) -> dict[str, Any]:
    """The modules of a filter of two states, both of which are observed, with a motion without noise."""
    return {**parts(members), "transition": LearnedTransition(torch.nn.Linear(2, 2))}


def iterated() -> IEnKS:
    """An iterated smoother."""
    return IEnKS(**still(), observation_key="observation")


def particles() -> ParticleFilter:
    """A particle filter whose motion has a density."""
    likelihood = GaussianLikelihood(sensor_key="observation")
    return ParticleFilter(**still(16), likelihood=likelihood, process_noise=0.1)


#: Each is fed as a filter is: in sequences all of them, in steps and environments those that are filters.
SMOOTHERS = (
    fed.Subject("RTSSmoother, Kalman", lambda: RTSSmoother(linear_kalman())),
    fed.Subject("RTSSmoother, UKF", lambda: RTSSmoother(linear_filter("UKF"), 2)),
    fed.Subject("EnRTS", lambda: EnRTS(linear_denkf("etkf"))),
    fed.Subject("EnKS", lambda: EnKS(linear_denkf("sakov"), 2)),
    fed.Subject("ParticleSmoother", lambda: ParticleSmoother(particles())),
)
FILTERS = (
    fed.Subject("FixedLag, Kalman", lambda: FixedLag(linear_kalman(), 2)),
    fed.Subject("FixedLag, ensemble", lambda: FixedLag(linear_denkf("etkf"), 2)),
    fed.Subject("FixedLag, particles", lambda: FixedLag(particles(), 2)),
    fed.Subject("IEnKS", iterated),
)


def _made() -> list[Subject]:
    frames = lambda smoother: smoother.sequence(fed._frames(SMOOTHERS[0]))  # noqa: E731
    of_ensemble, of_moments = {"filter": linear_kalman()}, {"filter": linear_denkf("etkf")}
    modules = dict.fromkeys(("transition", "observation", "noise", "initial"), MODULE)
    lag, filters = {"lag": LAG}, {"filter": FILTER}
    ensemble = lambda: {"filter": linear_denkf("etkf")}  # noqa: E731
    return [
        Subject("RTSSmoother", RTSSmoother, lambda: {"filter": linear_kalman()}, {**lag, **filters}, frames),
        Subject("EnRTS", EnRTS, ensemble, {**lag, **filters, "damping": DAMPING}, frames),
        Subject("EnKS", EnKS, ensemble, {**lag, **filters}, frames),
        Subject("ParticleSmoother", ParticleSmoother, lambda: {"filter": particles()}, {**lag, **filters}, frames),
        Subject("FixedLag", FixedLag, lambda: {**ensemble(), "lag": 2}, {"lag": COUNT, **filters}, frames),
        Subject(
            "IEnKS",
            IEnKS,
            lambda: {**still(), "observation_key": "observation"},
            {**modules, "sensor": {"text": "x"}, "iterations": COUNT, "inflation": POSITIVE, "process_noise": STDS},
            frames,
        ),
        *(
            Subject(f"{make.__name__} of another belief", make, dict, {"filter": {"another": given["filter"]}})
            for make, given in (
                (RTSSmoother, of_moments),
                (EnRTS, of_ensemble),
                (EnKS, of_ensemble),
                (ParticleSmoother, of_ensemble),
            )
        ),
    ]


def _smoothed(subject: fed.Subject, damage: fed.Damage, folder: Path) -> TensorDict:
    smoother = fed._seeded(subject.make)
    torch.manual_seed(2)
    out = smoother.sequence(damage(subject, fed._frames(subject)))
    keys = getattr(smoother, "smoothed_keys", None) or [key for key in smoother.out_keys if key[0] == "smoothed"]
    return out.select(*keys)


def _equals(subject: fed.Subject, damage: fed.Damage, result: TensorDict, *, tolerance: float = 0.0) -> bool:
    expected = _smoothed(subject, damage, Path())
    return finite(result) and same(result, expected, rtol=tolerance, atol=tolerance)


def _large(subject: fed.Subject, damage: fed.Damage, result: TensorDict) -> bool:
    """Right where a reading is treated as missing, or all is finite and as in double precision."""
    if _equals(subject, fed._unobserved, result):
        return True
    smoother = fed._seeded(subject.make).double()
    frames = damage(subject, fed._frames(subject))
    frames["observation"] = frames["observation"].double()
    torch.manual_seed(2)
    expected = smoother.sequence(frames).select(*result.keys(True, True))
    near = {key: value.double() for key, value in result.items(True, True)}
    return finite(result) and all(
        torch.allclose(near[key], expected[key].double(), rtol=1e-3, atol=1e-3 * float(expected[key].abs().max()))
        for key in near
    )


def _read() -> Iterator[Case]:
    """Recordings with damaged readings and masks."""
    for subject in (*SMOOTHERS, *FILTERS):
        for what, damage in fed.READINGS.items():
            right: Any = None
            if what in ("1e25", "-1e38"):
                right = partial(_large, subject, damage)
            elif what == "int64":
                right = partial(_equals, subject, fed._rounded, tolerance=1e-5)
            elif what in ("float64", "float16"):
                right = partial(_equals, subject, fed._sound, tolerance=1e-4 if what == "float64" else 3e-2)
            act = partial(_smoothed, subject, damage)
            yield Case("smoothers", f"{subject.name}: reading {what}", (subject.reading,), act, right)
        for value in (torch.nan, torch.inf, 1e38):
            act, right = partial(_smoothed, subject, fed._hidden(value)), partial(_equals, subject, fed._unobserved)
            yield Case(
                "smoothers", f"{subject.name}: {value} where the mask says missing", ("observation",), act, right
            )
        for what, damage in fed.MASKS.items():
            right = partial(_equals, subject, fed._sound) if what != "too wide" else None
            act = partial(_smoothed, subject, damage)
            yield Case("smoothers", f"{subject.name}: mask {what}", ("observed",), act, right)
        layouts: dict[str, tuple[tuple[str, ...], Any]] = {
            "without time": (("batch", "time", "batch_size"), lambda s, x: s.sequence(x[0, 0])),
            "of no steps": (("step", "time", "batch_size"), lambda s, x: s.sequence(x[:, :0])),
            "keep names nothing": (("keep",), lambda s, x: s.sequence(x, keep=["nothing"])),
            "detach_every zero": (("detach_every",), lambda s, x: s.sequence(x, detach_every=0)),
        }
        for what, (words, run) in layouts.items():
            act = partial(fed._act_layout, subject, run)
            yield Case("smoothers", f"{subject.name}: a sequence {what}", words, act)
    for subject in FILTERS:
        for run in ("step", "transform"):
            for what in ("a NaN", "all NaN", "inf", "missing", "too wide", "without its last dimension"):
                act = partial(fed._damaged, subject, run, fed.READINGS[what])
                yield Case("smoothers", f"{subject.name}, {run}: reading {what}", (subject.reading,), act)
        for number, key in enumerate(fed._seeded(subject.make).carry_keys):
            numbers = () if key[-1] == "age" else ("a NaN", "inf")  # an age counts steps, and is no floating number
            for what in (*numbers, "missing", "too wide", "a dimension less"):
                act = partial(fed._carried, subject, number, fed.CARRIED[what])
                right = partial(fed._unharmed, subject)
                yield Case("smoothers", f"{subject.name}: belief {key} {what}", fed._words(key), act, right)


def cases() -> Iterator[Case]:
    """All damaged arguments, readings and beliefs."""
    yield from cases_of("smoothers", _made())
    yield from _read()
