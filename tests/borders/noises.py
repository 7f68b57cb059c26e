"""Covariances, times, quaternions and rates among the entries of a filter."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import torch
from hypothesis import strategies as st
from torch import Tensor

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import INF, NAN, put, spoiled
from benchmarks.reliability.target import Target
from tests.borders.readings import AT, both, fed, unobserved
from tests.diagnosis.noises_for_tests import Given, attitude, filter_of, sound_frames
from torch_denkf.imperfect import RejectReadings

GAUSSIAN = ("KalmanFilter", "EKF", "UKF", "FusedEKF")
SAMPLED = ("etkf", "perturbed", "sakov", "particles", "FusedEnsemble")
SOUND = torch.tensor([[0.5, 0.1], [0.1, 0.3]])
VARIANCES = d.of(-1.0, -1e30, NAN, INF, others=st.floats(-1e30, -1e-6)).each(
    lambda value: spoiled(1, value)(SOUND.diagonal())
)
#: Matrices ``[[a, b], [c, e]]`` that are no covariance.
COVARIANCES = d.Wrong(
    {
        "a negative variance": (0.5, 0.1, 0.1, -0.02),
        "all -1": (-1.0, -1.0, -1.0, -1.0),
        "indefinite": (1.0, 2.0, 2.0, 1.0),
        "hardly indefinite": (1.0, 1.01, 1.01, 1.0),
        "one triangle": (1.0, 50.0, 0.0, 1.0),
        "the other triangle": (1.0, 0.0, 50.0, 1.0),
        "not symmetric": (1.0, 0.3, 0.2, 1.0),
        "zero beside a correlation": (0.0, 0.1, 0.1, 1.0),
        "nan": (0.5, NAN, 0.1, 0.3),
        "inf": (INF, 0.1, 0.1, 0.3),
        "mixed units": (1e6, 2.0, 2.0, 1e-6),
    },
    d.drawn(st.floats(1.01, 1e6).map(lambda much: (1.0, much, much, 1.0))),
).each(lambda numbers: torch.tensor(numbers).view(2, 2))
FAR = d.of(0.0, -1.0, 1e15, 1e30, NAN, INF, others=st.floats(1e18, 3e38) | st.floats(-3e38, -1e18))


def _noise(name: str, way: str, key: str, sound: Tensor, wrong: d.Wrong) -> Iterator[Target]:
    build = partial(filter_of, name, Given("r", ("sensor", "noise")), Given("q", ("forecast", "noise")))
    frames = lambda: sound_frames().set(key, sound.expand(2, 4, *sound.shape).clone())  # noqa: E731
    source = fed("noises", name, build, frames, way)
    changes, hide = wrong.each(lambda value: put(key, spoiled(AT, value))), unobserved(*AT)
    # An infinite variance is that of a reading that says nothing.
    nothing = source.like(unobserved(*AT, 1, width=2), 1e-5)
    rights = {"inf": nothing} if key == "r" and name in SAMPLED else {}
    what = f"{key.upper()}, {'variances' if sound.ndim == 1 else 'covariance'}"
    yield source.target(what, changes, None, key, rights=rights)
    if key == "r":
        reject = RejectReadings({"observation": "observed"}, noises={"observation": "r"})
        for how, then in (("hidden", lambda change: both(hide, change)), ("rejected", lambda one: both(one, reject))):
            yield source.target(f"{what}, {how}", changes.each(then), source.like(hide, 1e-5), key)


def targets() -> Iterator[Target]:
    """Yields R and Q, shown and hidden and rejected; times, quaternions and rates that are none."""
    for way in ("step", "sequence"):
        for name in GAUSSIAN + SAMPLED:
            for key in ("r", "q"):
                yield from _noise(name, way, key, SOUND.diagonal(), VARIANCES)
                if name in GAUSSIAN or key == "q":
                    yield from _noise(name, way, key, SOUND, COVARIANCES)
        for kind in ("EKF", "etkf"):
            make_it, rows = (partial(lambda kind, part: attitude(kind)[part], kind, part) for part in (0, 1))
            source = fed("noises", f"{kind} of an attitude", make_it, rows, way)
            for key in ("y", "dt", "gyro"):
                changes = FAR.each(lambda value, key=key: put(key, spoiled((1, 1), value)))
                yield source.target(key, changes, d.finite, key)
