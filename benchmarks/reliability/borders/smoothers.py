"""Smoothers: their constructors, and the recordings that they read."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import torch

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders import filters_fed as fed
from benchmarks.reliability.borders.around import NO_FILTER
from benchmarks.reliability.target import Subject, Target, targets_of
from tests.borders.filters_made import parts
from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.gaussian_for_tests import linear_filter
from torch_denkf.baselines import IEnKS
from torch_denkf.filters import ParticleFilter
from torch_denkf.modules import GaussianLikelihood, LearnedTransition
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, ParticleSmoother, RTSSmoother


def still(members: int = 8) -> dict[str, Any]:
    """The modules of a filter of two states, both of which are observed, with a motion without noise."""
    return {**parts(members), "transition": LearnedTransition(torch.nn.Linear(2, 2))}


def iterated() -> IEnKS:
    """An iterated smoother."""
    return IEnKS(**still(), observation_key="observation")


def particles() -> ParticleFilter:
    """A particle filter whose motion has a density."""
    likelihood = GaussianLikelihood(observation_key="observation")
    return ParticleFilter(**still(16), likelihood=likelihood, process_noise=0.1)


_one = partial(fed.Fed, runs=("smoothed",), near=3.0)
#: Each is fed as a filter is: in sequences all of them, in steps and environments those that are filters.
SMOOTHERS = (
    _one("RTSSmoother, Kalman", lambda: RTSSmoother(linear_kalman())),
    _one("RTSSmoother, UKF", lambda: RTSSmoother(linear_filter("UKF"), 2)),
    _one("EnRTS", lambda: EnRTS(linear_denkf("etkf"))),
    _one("EnKS", lambda: EnKS(linear_denkf("sakov"), 2)),
    _one("ParticleSmoother", lambda: ParticleSmoother(particles())),
)
FILTERS = (
    _one("FixedLag, Kalman", lambda: FixedLag(linear_kalman(), 2), types=False),
    _one("FixedLag, ensemble", lambda: FixedLag(linear_denkf("etkf"), 2), types=False),
    _one("FixedLag, particles", lambda: FixedLag(particles(), 2), types=False),
    _one("IEnKS", iterated, types=False),
)
REFUSED = fed.BROKEN | {what: fed.entry(change) for what, change in fed.SHAPES.items()}


def _made() -> Iterator[Subject]:
    use = lambda smoother: smoother.sequence(SMOOTHERS[0].frames())  # noqa: E731
    moments, ensemble = (lambda: {"filter": linear_kalman()}), (lambda: {"filter": linear_denkf("etkf")})
    wrong = {"lag": d.COUNT.but("zero"), "filter": NO_FILTER}
    iterated = {"sensor": d.of("x"), "variance_ceiling": None}
    yield Subject(RTSSmoother, moments, use, wrong)
    yield Subject(EnRTS, ensemble, use, {**wrong, "damping": d.POSITIVE | {"beyond one": 1.5}})
    yield Subject(EnKS, ensemble, use, wrong)
    yield Subject(ParticleSmoother, lambda: {"filter": particles()}, use, wrong)
    yield Subject(FixedLag, lambda: {**ensemble(), "lag": 2}, use, {**wrong, "lag": d.COUNT})
    yield Subject(IEnKS, lambda: {**still(), "observation_key": "observation"}, use, iterated)
    for make, sound in ((RTSSmoother, ensemble), (EnRTS, moments), (EnKS, moments), (ParticleSmoother, moments)):
        name, another = f"{make.__name__} of another belief", d.Wrong({"another": sound()["filter"]})
        yield Subject(make, wrong={"filter": another}, name=name)


def targets() -> Iterator[Target]:
    """Arguments, readings and beliefs of smoothers."""
    border = "smoothers"
    yield from targets_of(border, *_made())
    for one in (*SMOOTHERS, *FILTERS):
        yield from fed.everything(border, one)
        yield from fed.laid_out(border, one, fed.SEQUENCES)
    for one in FILTERS:
        for run in ("step", "transform"):
            yield fed.fed_with(border, one, run, "reading", REFUSED)
        yield from fed.carried(border, one)
