"""Readings, masks and truths that are points of a space: filters on many spaces, what rejects, and what scores."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import finite, same
from benchmarks.reliability.target import Target
from tests.filters.test_hidden_numbers import SPACES, make
from torch_denkf.diagnosis import evaluate
from torch_denkf.functional.manifolds import Circle, Euclidean, Product, Space, places_of
from torch_denkf.imperfect import RejectReadings

NAN, INF = float("nan"), float("inf")
T, AT = 3, 1  # steps, and the one that is damaged
KINDS = ("EKF", "UKF", "etkf", "particles", "fused")
Frames = TensorDict
Change = Callable[[Space, Frames], Frames]


@cache
def frames(name: str) -> Frames:
    """Sound frames ``[T]`` of one run."""
    space, rng = SPACES[name], torch.Generator().manual_seed(1)
    start = space.exp(0.3 * torch.randn(space.tangent_dim, generator=rng))
    data = Frames({"start": start.expand(T, -1).clone(), "state": start.expand(T, -1).clone()}, [T])
    data["pose"] = space.plus(start, 0.2 * torch.randn(T, space.tangent_dim, generator=rng))
    data["observed"] = torch.ones(T, space.tangent_dim, dtype=torch.bool)
    return data


def run(kind: str, name: str, change: Change, on_bad: Any = "raise") -> Frames:
    """Runs a filter on changed frames, behind a module that rejects readings."""
    torch.manual_seed(0)
    filter, data = make(kind, SPACES[name]), change(SPACES[name], frames(name).clone())
    front = RejectReadings({"pose": "observed"}, spaces={"pose": SPACES[name]}, on_bad=on_bad)
    with torch.no_grad():
        return filter.sequence(front(data)).select(*filter.belief_keys)


def stepped(kind: str, name: str, change: Change) -> Frames:
    """Steps a filter on changed frames, without that module."""
    torch.manual_seed(0)
    filter, data = make(kind, SPACES[name]), change(SPACES[name], frames(name).clone())
    with torch.no_grad():
        belief = filter.initialise(data[0].copy())
        for row in data[1:].unbind(0):
            belief = filter.step(belief.update(row))
    return belief.select(*filter.belief_keys)


def _sound(space: Space, data: Frames) -> Frames:
    return data


def _first_hidden(space: Space, data: Frames, part: slice | None = None) -> Frames:
    """The first part of the space is hidden."""
    data["observed"][AT, places_of(space)[0].tangent if part is None else part] = False
    return data


def point(change: Callable[[Tensor, Space], Tensor | None]) -> Change:
    """A changed reading of one step; of ``None`` and of another shape those of all steps."""

    def act(space: Space, data: Frames) -> Frames:
        changed = change(data["pose"], space)
        return data.exclude("pose") if changed is None else data.set("pose", changed)

    return act


def number(value: float, place: Any = 0) -> Change:
    """A number in the reading of one step."""

    def act(reading: Tensor, space: Space) -> Tensor:
        reading[AT, ..., place] = value
        return reading

    return point(act)


def behind(hide: Change, then: Change) -> Change:
    """A change of what a mask hides."""
    return lambda space, data: then(space, hide(space, data))


def _longer(reading: Tensor, space: Space) -> Tensor:
    """Another length of quaternions is the same rotation."""
    for place in places_of(space):
        if place.space.point_dim > place.space.tangent_dim:
            reading[AT, place.point.start : place.point.start + 4] *= 1.5
    return reading


ALL = slice(None)
SHAPES: dict[str, Change] = {
    "missing": point(lambda reading, space: None),
    "a number": point(lambda reading, space: reading[:, :1]),
    "without its last dimension": point(lambda reading, space: reading[:, 0]),
    "too wide": point(lambda reading, space: torch.cat([reading, reading[:, :1]], -1)),
    "too narrow": point(lambda reading, space: reading[:, :-1]),
    "flags": point(lambda reading, space: reading > 0),
}
BROKEN = {"a NaN": number(NAN), "all NaN": number(NAN, ALL), "inf": number(INF, -1), "1e25": number(1e25, -1)}


def like(change: Change, near: float = 1e-6, **options: Any) -> Callable[..., bool]:
    """Right where a belief is that of other frames."""
    return lambda way, result: finite(result) and same(result, way(change, **options), rtol=near, atol=near)


def target(name: str, way: Callable[..., Any], wrong: d.Wrong, word: str, right: Any = None) -> Target:
    """Changed frames in one way to run a filter."""
    rights = lambda what, change: right and partial(right, way)  # noqa: E731
    return Target("spaces", name, (word,), lambda change, folder: way(change), wrong, rights=rights)


def readings(kind: str, name: str) -> Iterator[Target]:
    """Readings that are none, and those that are the same in other numbers."""
    rotations = any(place.space.point_dim > place.space.tangent_dim for place in places_of(SPACES[name]))
    for what, way in (("sequence", partial(run, kind, name)), ("step", partial(stepped, kind, name))):
        wrong = dict(SHAPES) if what == "step" else SHAPES | BROKEN
        if rotations:
            wrong["zeros"] = number(0.0, ALL)
            longer = d.Wrong({"a longer quaternion": point(_longer)})
            yield target(f"{kind}, {name}, {what}, same reading", way, longer, "pose", like(_sound, 1e-5))
        drawn = st.builds(
            lambda value, place: (f"{value} at {place}", number(value, place)),
            st.sampled_from([NAN, INF, -INF]),
            st.integers(0, SPACES[name].point_dim - 1),
        )
        yield target(f"{kind}, {name}, {what}, reading", way, d.Wrong(wrong, drawn), "pose")


def masked(kind: str, name: str) -> Iterator[Target]:
    """Numbers that a mask hides, and masks that are none."""
    space = SPACES[name]
    for what, hide in (("a part", _first_hidden), ("all", partial(_first_hidden, part=ALL))):
        numbers = places_of(space)[0].point if what == "a part" else ALL
        fill = lambda value, hide=hide, numbers=numbers: behind(hide, number(value, numbers))  # noqa: E731
        wrong = d.Wrong(
            {str(value): fill(value) for value in (0.0, NAN, INF, 1e6, 1e30)},
            st.floats(width=32).map(lambda value, fill=fill: (f"{value}", fill(value))),
        )
        for run_name, way in (("sequence", run), ("step", stepped)):
            way = partial(way, kind, name)
            yield target(f"{kind}, {name}, {run_name}, behind a mask of {what}", way, wrong, "pose", like(hide, 0.0))
    masks = {
        "too wide": lambda mask: torch.cat([mask] * 3, -1),
        "too narrow": lambda mask: torch.cat([mask] * 2, -1)[:, : max(2, space.tangent_dim - 1)],
        "without its last dimension": lambda mask: mask[:, 0],
    }
    if space.point_dim != space.tangent_dim:
        masks["of a point's numbers"] = lambda mask: torch.ones(T, space.point_dim, dtype=torch.bool)
    if space.tangent_dim <= 3:
        masks.pop("too narrow")
    wrong = d.Wrong({what: partial(_changed, key="observed", change=change) for what, change in masks.items()})
    numbers = d.Wrong({"of numbers": partial(_changed, key="observed", change=Tensor.float)})
    for run_name, way in (("sequence", run), ("step", stepped)):
        way = partial(way, kind, name)
        yield target(f"{kind}, {name}, {run_name}, mask", way, wrong, "observed")
        yield target(f"{kind}, {name}, {run_name}, a mask", way, numbers, "observed", like(_sound, 0.0))


def _changed(space: Space, data: Frames, key: str, change: Callable[[Tensor], Tensor]) -> Frames:
    return data.set(key, change(data[key]))


def rejected(kind: str, name: str) -> Iterator[Target]:
    """A part that is broken is a missing reading."""
    place = places_of(SPACES[name])[0]
    lost = place.tangent if place.space.flat is None else slice(0, 1)
    way = partial(run, kind, name, on_bad="mask")
    wrong = d.Wrong(
        {what: number(value) for what, value in (("NaN", NAN), ("inf", INF), ("-inf", -INF), ("1e25", 1e25))}
    )
    if place.space.point_dim > place.space.tangent_dim:
        wrong |= {"zeros": number(0.0, slice(0, 4))}
    right = like(partial(_first_hidden, part=lost), 0.0)
    yield target(f"{kind}, {name}, rejected", way, wrong, "pose", right)


def scored(name: str) -> Iterator[Target]:
    """Truths that are none, of beliefs that are scored."""
    space = SPACES[name]

    def way(change: Change, folder: Path | None = None) -> Any:
        torch.manual_seed(0)
        filter, data = make("EKF", space), change(space, frames(name).clone())
        out = evaluate(filter, data)
        return [out.rmse, out.coverage, out.crps, out.nees.mean]

    def truth(change: Callable[[Tensor], Tensor]) -> Change:
        return partial(_changed, key="state", change=change)

    shapes = {
        "too wide": truth(lambda state: torch.cat([state, state], -1)),
        "without its last dimension": truth(lambda state: state[:, 0]),
        "all NaN": truth(lambda state: state * NAN),
        "one step": truth(lambda state: state[None].expand(T, T, -1)),
    }
    missing = d.Wrong({"missing": lambda space, data: data.exclude("state")})
    yield target(f"evaluate, {name}, truth", way, d.Wrong(shapes), "truth")
    yield target(f"evaluate, {name}, true states", way, missing, "state")


def products() -> Iterator[Target]:
    """Yields values that are no space, where one is due."""
    wrong = d.Wrong({"nothing": None, "text": "SO3", "a class": Circle, "a number": 3})
    for what, act in (
        ("Product", lambda value, folder: Product(Euclidean(1), value)),
        ("reading_space", lambda value, folder: make("EKF", Euclidean(2), torch.nn.Identity(), value)),
        ("spaces", lambda value, folder: RejectReadings({"pose": "observed"}, spaces={"pose": value})),
    ):
        yield Target("spaces", f"no space, {what}", (what, "space", "spaces", "model", "observation"), act, wrong)


def targets() -> Iterator[Target]:
    """Readings, masks, rejection and scores of all spaces; filters take turns."""
    for turn, name in enumerate(SPACES):
        for kind in dict.fromkeys(("EKF", KINDS[turn % len(KINDS)])):
            yield from readings(kind, name)
            yield from masked(kind, name)
            yield from rejected(kind, name)
        yield from scored(name)
    yield from products()
