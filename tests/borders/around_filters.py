"""Constructors around filters: smoothers, transforms, losses and environments."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import torch
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import INF, NAN
from benchmarks.reliability.target import Subject, Target, targets_of
from tests.borders.filters_made import parts
from tests.filters.factories import linear_denkf, linear_kalman
from tests.filters.particle_for_tests import bootstrap
from torch_denkf import envs, objectives
from torch_denkf.baselines import IEnKS
from torch_denkf.data import Episode, EpisodeReplay
from torch_denkf.filters import ParticleFilter
from torch_denkf.modules import GaussianLikelihood, LearnedTransition
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, ParticleSmoother, RTSSmoother

NO_FILTER = d.of(None, "x", torch.nn.Linear(2, 2))
FRAMES = TensorDict({"observation": torch.zeros(3, 5, 2), "state": torch.zeros(3, 5, 2)}, [3, 5])


def still(members: int = 8) -> dict[str, Any]:
    """Returns the modules of a filter of two states, both of which are observed, with a motion without noise."""
    return {**parts(members), "transition": LearnedTransition(torch.nn.Linear(2, 2))}


def iterated() -> IEnKS:
    """Returns an iterated smoother."""
    return IEnKS(**still(), observation_key="observation")


def particles() -> ParticleFilter:
    """Returns a particle filter whose motion has a density."""
    likelihood = GaussianLikelihood(observation_key="observation")
    return ParticleFilter(**still(16), likelihood=likelihood, process_noise=0.1)


def _moments() -> dict[str, Any]:
    return {"filter": linear_kalman()}


def _ensemble() -> dict[str, Any]:
    return {"filter": linear_denkf("etkf")}


def _smoothers() -> Iterator[Subject]:
    use, wrong = (lambda smoother: smoother.sequence(FRAMES)), {"lag": d.COUNT.but("zero"), "filter": NO_FILTER}
    damping, iterated = d.POSITIVE | {"beyond one": 1.5}, {"sensor": d.of("x"), "variance_ceiling": None}
    yield Subject(RTSSmoother, _moments, use, wrong)
    yield Subject(EnRTS, _ensemble, use, {**wrong, "damping": damping})
    yield Subject(EnKS, _ensemble, use, wrong)
    yield Subject(ParticleSmoother, lambda: {"filter": particles()}, use, wrong)
    yield Subject(FixedLag, lambda: {**_ensemble(), "lag": 2}, use, {**wrong, "lag": d.COUNT})
    yield Subject(IEnKS, lambda: {**still(), "observation_key": "observation"}, use, iterated)
    for make, sound in ((RTSSmoother, _ensemble), (EnRTS, _moments), (EnKS, _moments), (ParticleSmoother, _moments)):
        another = {"filter": d.Wrong({"of another belief": sound()["filter"]})}
        yield Subject(make, wrong=another, name=f"{make.__name__} of another belief")


def _transforms() -> Iterator[Subject]:
    use = lambda transform: transform(TensorDict({"pixels": torch.rand(2, 3, 12, 12)}, [2]))  # noqa: E731
    bounds = d.of((2.0, 1.0), (NAN, 1.0), (0.0, INF), (1.0,), "ab")
    shares = d.of((1.5, 0.5), (-0.5, 0.5), (NAN, 0.5), (0.5,), "ab")
    kernel = d.COUNT | {"even": 4, "three numbers": (3, 3, 3)}
    yield Subject(envs.MissingFrames, use=use)
    yield Subject(envs.BlackFrames, use=use)
    yield Subject(envs.Blur, use=use, wrong={"kernel": kernel})
    yield Subject(envs.Brightness, use=use, wrong={"gain": bounds | {"negative": (-1.0, 1.0)}, "offset": bounds})
    yield Subject(envs.OccludingBox, use=use, wrong={"size": shares, "position": shares})
    yield Subject(envs.SaltAndPepper, use=use, wrong={"fraction": d.of(-0.1, 0.7, NAN, "x")})


def _losses() -> Iterator[Subject]:
    scale = d.vector(2, positive=True) | {"inf": [INF] * 2}
    weights = dict.fromkeys(("state", "transition", "nll"), d.NOT_NEGATIVE)
    common = {"filter": NO_FILTER, "state_scale": scale, **weights}
    denkf = {**common, **dict.fromkeys(("observation", "kl"), d.NOT_NEGATIVE)}
    mixture = {**common, "mean": d.NOT_NEGATIVE, "component_std": d.POSITIVE}
    transition = {"state_scale": scale, "spread": d.NOT_NEGATIVE, "members": d.LARGE_COUNT}
    batch = lambda loss: loss(FRAMES.clone())  # noqa: E731
    soft = lambda: {"filter": bootstrap(8, resampling="soft")}  # noqa: E731
    yield Subject(objectives.DEnKFLoss, lambda: {**_ensemble(), "sensor": 0.0}, batch, denkf)
    yield Subject(objectives.GaussianLoss, _moments, batch, {**common, "dims": d.dims(2)})
    yield Subject(objectives.MixtureLoss, soft, batch, mixture)
    yield Subject(objectives.TransitionLoss, _ensemble, batch, transition)


@cache
def _rows() -> EpisodeReplay:
    step = torch.arange(10).repeat(2).unsqueeze(-1)
    rows = TensorDict({"step": step, "time": step * 0.1, "state": torch.rand(20, 2)}, [20])
    return EpisodeReplay(rows, [Episode("a", 0, 10), Episode("b", 10, 10)], for_tests=lambda episode: False)


def _linear() -> dict[str, Any]:
    eye, std = torch.eye(2), [0.1, 0.1]
    return {"transition": 0.9 * eye, "observation": eye, "transition_std": std, "observation_std": std}


#: Wrong stretches of what an environment replays.
STRETCHES = {
    "start": d.of(-1, 100, "somewhere", 1.5),
    "length": d.of(1, -1, 100, "x"),
    "batch_size": d.of([-1], "x", [1.5]),
}


def _environments() -> Iterator[Subject]:
    roll = lambda env: env.rollout(3)  # noqa: E731
    data = {"data": d.of(None, "x"), "episodes": d.of("z", 7, []), **STRETCHES}
    linear = {
        "transition": d.matrix(2, 2),
        "observation": d.matrix(2, 2).but("a row more", "three dimensions"),
        **dict.fromkeys(("transition_std", "observation_std", "initial_std"), d.vector(2, negative=False)),
        "missing": d.SHARE,
        "max_steps": d.COUNT,
        "control": d.matrix(2, 1).but("a column more", "three dimensions"),
        "batch_size": STRETCHES["batch_size"],
    }
    yield Subject(envs.ReplayEnv, lambda: {"data": _rows()}, roll, data)
    yield Subject(envs.LinearGaussianEnv, _linear, roll, linear)


def targets() -> Iterator[Target]:
    """Yields all arguments."""
    kinds = {"smoothers": _smoothers, "transforms": _transforms, "losses": _losses, "environments": _environments}
    for border, subjects in kinds.items():
        yield from targets_of(border, *subjects())
