"""Readings that are points of spaces, and truths that are compared with beliefs on them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import INF, NAN, Change, put, spoiled
from benchmarks.reliability.target import Source, Target
from tests.borders.readings import ALL, HIDDEN, both, fed, unobserved
from tests.filters.test_hidden_numbers import SPACES, make
from torch_denkf.diagnosis import evaluate
from torch_denkf.functional.manifolds import Circle, Euclidean, Product, places_of
from torch_denkf.imperfect import RejectReadings

KINDS = ("EKF", "UKF", "etkf", "particles", "fused")
STEP = 1  # the one of three that is damaged


@cache
def points(name: str) -> TensorDict:
    """Sound frames ``[T]`` of one run on a space."""
    space, rng = SPACES[name], torch.Generator().manual_seed(1)
    start = space.exp(0.3 * torch.randn(space.tangent_dim, generator=rng))
    data = TensorDict({"start": start.expand(3, -1).clone(), "state": start.expand(3, -1).clone()}, [3])
    data["pose"] = space.plus(start, 0.2 * torch.randn(3, space.tangent_dim, generator=rng))
    return data.set("observed", torch.ones(3, space.tangent_dim, dtype=torch.bool))


def _longer(name: str) -> Change:
    """Another length of quaternions, which is the same rotation."""

    def change(reading: Tensor) -> Tensor:
        factors = torch.ones(SPACES[name].point_dim)
        for place in places_of(SPACES[name]):
            if place.space.point_dim > place.space.tangent_dim:
                factors[place.point.start : place.point.start + 4] = 1.5
        return spoiled(STEP, factors * reading[STEP])(reading)

    return change


def _on_space(kind: str, name: str) -> Iterator[Target]:
    space, first = SPACES[name], places_of(SPACES[name])[0]
    rotations = any(place.space.point_dim > place.space.tangent_dim for place in places_of(space))
    build, frames, pose, mask = partial(make, kind, space), partial(points, name), partial(put, "pose"), "observed"
    front = lambda on_bad: RejectReadings({"pose": mask}, spaces={"pose": space}, on_bad=on_bad)  # noqa: E731
    checked = fed("spaces", f"{kind}, {name}", build, frames, "sequence", front("raise"))
    broken = d.broken(STEP, places=st.tuples(st.just(STEP), st.integers(0, space.point_dim - 1)))
    zeros = {"zeros": spoiled(STEP, 0.0)} if rotations else {}
    shapes = d.SHAPES | {"flags": lambda value: value > 0, "a number": lambda value: value[:, :1]}
    shapes = shapes.without("too narrow") if space.point_dim == 2 else shapes  # that is a number
    masks = {
        "too wide": lambda value: torch.cat([value] * 3, -1),
        "without its last dimension": lambda value: value[:, 0],
        **({"too narrow": lambda value: value[:, :-1]} if space.tangent_dim > 3 else {}),
        **({"of a point's numbers": lambda value: torch.ones(3, space.point_dim) > 0} if rotations else {}),
    }
    for source in (checked, fed("spaces", f"{kind}, {name}", build, frames, "step")):
        far = {"1e25": spoiled((STEP, -1), 1e25)} if source is checked else {}
        yield source.target("reading", (shapes | broken | zeros | far).each(pose), None, "pose")
        if rotations:
            yield source.target("same reading", {"longer": pose(_longer(name))}, source.like(near=1e-5), "pose")
        for what, hidden, numbers in (("a part", first.tangent, first.point), ("all", ALL, ALL)):
            hide = unobserved(STEP, hidden)
            wrong = HIDDEN.each(
                lambda value, hide=hide, numbers=numbers: both(hide, pose(spoiled((STEP, numbers), value)))
            )
            yield source.target(f"behind a mask of {what}", wrong, source.like(hide), "pose")
        yield source.target(mask, d.Wrong(masks).each(partial(put, mask)), None, mask)
        yield source.target("a mask of numbers", put(mask, Tensor.float), source.like(), mask)
    rejecting = fed("spaces", f"{kind}, {name}", build, frames, "sequence", front("mask"))
    part = {f"{value}": spoiled((STEP, 0), value) for value in (NAN, INF, -INF, 1e25)}
    if first.space.point_dim > first.space.tangent_dim:
        part["zeros"] = spoiled((STEP, slice(0, 4)), 0.0)
    lost = first.tangent if first.space.flat is None else slice(0, 1)
    yield rejecting.target("rejected", d.Wrong(part).each(pose), rejecting.like(unobserved(STEP, lost)), "pose")


def _scored(name: str) -> Iterator[Target]:
    """Truths that are none, of beliefs that are scored."""

    def read(data: TensorDict) -> Any:
        torch.manual_seed(0)
        out = evaluate(make("EKF", SPACES[name]), data)
        return [out.rmse, out.coverage, out.crps, out.nees.mean]

    truths = {
        "too wide": lambda state: torch.cat([state, state], -1),
        "without its last dimension": lambda state: state[:, 0],
        "all NaN": lambda state: state * NAN,
        "one step": lambda state: state[None].expand(3, 3, -1),
    }
    source = Source("spaces", partial(points, name), read, f"evaluate, {name}, ")
    yield source.target("truth", d.Wrong(truths).each(partial(put, "state")), None, "truth")
    yield source.target("true states", put("state", d.MISSING), None, "state")


def targets() -> Iterator[Target]:
    """Yields readings, masks and truths on all spaces."""
    for turn, name in enumerate(SPACES):
        for kind in dict.fromkeys(("EKF", KINDS[turn % len(KINDS)])):
            yield from _on_space(kind, name)
        yield from _scored(name)
    for what, act in (
        ("Product", lambda value, folder: Product(Euclidean(1), value)),
        ("reading_space", lambda value, folder: make("EKF", Euclidean(2), torch.nn.Identity(), value)),
        ("spaces", lambda value, folder: RejectReadings({"pose": "observed"}, spaces={"pose": value})),
    ):
        words = (what, "space", "spaces", "model", "observation")
        yield Target("spaces", f"no space, {what}", words, act, d.of(None, "SO3", Circle, 3))
