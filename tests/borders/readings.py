"""Entries that are damaged and fed to what reads them: readings, masks, beliefs, noises, points of spaces, logs.

A source is what reads them in one way: a filter that steps, takes a sequence or sits in an environment, a smoother, or
what scores a filter. The expected result is that of the undamaged or masked entries.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import INF, NAN, Change, put, spoiled
from benchmarks.reliability.soaks.steps import EXACT, SAMPLED
from benchmarks.reliability.target import Source, Target
from tests.borders.around_filters import iterated, particles
from tests.filters.composed import ReplayedFrames
from tests.filters.factories import linear_denkf, linear_kalman, toy_denkf
from torch_denkf.filters import Filter
from torch_denkf.imperfect import RejectReadings
from torch_denkf.smoothers import EnKS, EnRTS, FixedLag, ParticleSmoother, RTSSmoother
from torch_denkf.transforms import DEnKFTransform

B, T = 3, 4
AT = (1, 2)  # row and time that are damaged
ALL = slice(None)
Front = Callable[[TensorDict], TensorDict]  # what stands in front of a filter, such as a rejection of bad readings


# ------------------------------------------------------------------------------------------------------ what is run


def step(filter: Filter, frames: TensorDict, front: Front) -> TensorDict:
    """Steps through the frames, as a robot does."""
    rows = frames.exclude("is_init").unbind(-1)
    carry, out = filter.initialise(rows[0].copy()), []
    for row in rows[1:]:
        carry = filter.step(front(carry.update(row)))
        out.append(carry.select(*filter.belief_keys).copy())
    return torch.stack(out, frames.ndim - 1)


def sequence(filter: Any, frames: TensorDict, front: Front) -> TensorDict:
    """Filters or smooths a sequence."""
    smoothed = [key for key in getattr(filter, "out_keys", ()) if key[0] == "smoothed"]
    keys = getattr(filter, "smoothed_keys", None) or smoothed or filter.belief_keys
    return filter.sequence(front(frames.copy())).select(*keys)


def transform(filter: Filter, frames: TensorDict, front: Front) -> TensorDict:
    """Filters in an environment that plays the frames."""
    inner = ReplayedFrames(frames)
    env = TransformedEnv(inner, Compose(front, DEnKFTransform(filter)))
    out = env.rollout(T - 1, inner.player(), break_when_any_done=False)
    return out["next"].select(*filter.belief_keys)


WAYS = {"step": step, "sequence": sequence, "transform": transform, "transform that rejects": transform}


def fed(
    border: str,
    name: str,
    make: Callable[[], Any],
    frames: Callable[[], TensorDict],
    way: str,
    front: Front = lambda frames: frames,
) -> Source:
    """Runs a filter on frames in one way; a warning of NaN in a sequence counts as an error."""

    def read(rows: TensorDict, *, double: bool = False) -> TensorDict:
        torch.manual_seed(0)
        filter = make().double() if double else make()
        torch.manual_seed(2)
        with warnings.catch_warnings(), torch.no_grad():
            warnings.filterwarnings("error", message="The belief is NaN")
            return WAYS[way](filter, rows, front)

    return Source(border, frames, read, f"{name}, {way}, ")


def both(first: Change, then: Change) -> Change:
    """Applies one change after another."""

    def change(frames: TensorDict) -> TensorDict:
        for one in (first, then):
            changed = one(frames)
            frames = frames if changed is None else changed
        return frames

    return change


def unobserved(*at: Any, width: int = 0) -> Change:
    """Returns a mask that is False in a place; of so many components, which then have masks of their own."""

    def change(frames: TensorDict) -> None:
        mask = frames["observed"]
        frames["observed"] = spoiled(at, False)(mask.expand(*mask.shape[:-1], width) if width else mask)

    return change


# ------------------------------------------------------------------------------------------------ filters, smoothers


@dataclass(frozen=True)
class Fed:
    """A filter or a smoother, and the entry that it reads.

    Args:
        border: of its targets.
        name: for the record.
        make: makes it.
        ways: how it is run.
        reading: the entry.
        width: its width.
        near: a factor of the tolerances of what is rounded.
        types: whether its belief may also come in other types.
    """

    border: str
    name: str
    make: Callable[[], Any]
    ways: tuple[str, ...] = ("step", "sequence", "transform")
    reading: str = "observation"
    width: int = 2
    near: float = 1.0
    types: bool = True

    def frames(self) -> TensorDict:
        """Sound frames ``[B, T]``."""
        random = torch.Generator().manual_seed(1)
        frames = TensorDict({self.reading: torch.randn(B, T, self.width, generator=random)}, [B, T])
        frames["action"] = torch.randn(B, T, 2, generator=random)
        frames["observed"] = torch.ones(B, T, 1, dtype=torch.bool)
        return frames.set("is_init", (torch.arange(T) == 0).expand(B, T).unsqueeze(-1))

    def source(self, way: str) -> Source:
        """The frames, run in this way."""
        front = RejectReadings({self.reading: "observed"}, on_bad="mask" if "rejects" in way else "raise")
        return fed(self.border, self.name, self.make, self.frames, way, front)


_smoother = partial(Fed, "smoothers", ways=("sequence",), near=3.0)
FILTERS = {name: Fed("readings", name, make) for name, make in (EXACT | SAMPLED).items()}
FILTERS["DEnKF, learned"] = Fed("readings", "DEnKF, learned", toy_denkf, reading="measurement", width=4)
ENSEMBLE = FILTERS["DEnKF, etkf"]
SMOOTHERS = (
    _smoother("RTSSmoother, Kalman", lambda: RTSSmoother(linear_kalman())),
    _smoother("RTSSmoother, UKF", lambda: RTSSmoother(EXACT["UKF"](), 2)),
    _smoother("EnRTS", lambda: EnRTS(linear_denkf("etkf"))),
    _smoother("EnKS", lambda: EnKS(linear_denkf("sakov"), 2)),
    _smoother("ParticleSmoother", lambda: ParticleSmoother(particles())),
)
#: Smoothers that are filters, too.
LAGGED = (
    _smoother("FixedLag, Kalman", lambda: FixedLag(linear_kalman(), 2), types=False),
    _smoother("FixedLag, ensemble", lambda: FixedLag(linear_denkf("etkf"), 2), types=False),
    _smoother("FixedLag, particles", lambda: FixedLag(particles(), 2), types=False),
    _smoother("IEnKS", iterated, types=False),
)

PLACES = st.tuples(st.integers(0, B - 1), st.integers(1, T - 1), st.integers(0, 1))
BROKEN = d.broken(*AT, places=PLACES)
LARGE = d.Wrong(
    {"1e25": ((*AT, 0), 1e25), "-1e38": (AT, -1e38)},
    d.drawn(st.floats(1e20, 3e38) | st.floats(-3e38, -1e20)).map(lambda one: (one[0], ((*AT, 0), one[1]))),
).each(lambda one: spoiled(*one))
TYPES = d.Wrong({"float64": Tensor.double, "float16": Tensor.half, "int64": lambda value: value.round().long()})
HIDDEN = d.of(NAN, 1e38, others=st.floats(width=32) | st.sampled_from([0.0, INF]))
MASKS = d.Wrong({"float": Tensor.float, "int64": Tensor.long, "without its last dimension": lambda mask: mask[..., 0]})
WIDE_MASK = d.Wrong({"too wide": lambda mask: mask.expand(*mask.shape[:-1], 5)})


def large(source: Source, change: Change, result: TensorDict) -> bool:
    """Tells whether a reading is treated as missing, or all is finite and as in double precision."""
    if source.like(unobserved(*AT))(result):
        return True

    def doubled(frames: TensorDict) -> TensorDict:
        floats = [key for key, value in frames.items() if value.is_floating_point()]
        return both(change, lambda changed: changed.update(changed.select(*floats).double()))(frames)

    with suppress(Exception):
        found, expected = d.leaves(result), d.leaves(source.damaged(doubled, double=True))
        return d.finite(result) and all(
            torch.allclose(found[key].double(), value.double(), rtol=1e-3, atol=1e-3 * float(value[AT[0]].abs().max()))
            for key, value in expected.items()
        )
    return False


def goes_on(source: Source, width: int, change: Change, result: TensorDict) -> bool:
    """Tells whether only the row that is damaged is as if it had not been observed, or computed right."""
    rows, near = [row for row in range(B) if row != AT[0]], {"rtol": 1e-5, "atol": 1e-5}
    hides = [unobserved(*AT)] + [unobserved(*AT, 0, width=width)] * (width == 2)  # a sensor's is hidden as a whole
    hidden = any(d.same(result[AT[0]], source.damaged(hide)[AT[0]], **near) for hide in hides)
    others = d.same(result[rows], source.reference()[rows], **near)
    return d.finite(result) and others and (hidden or large(source, change, result))


def readings(one: Fed) -> Iterator[Target]:
    """Damaged readings and masks, in every way to run it."""
    key, change = one.reading, partial(put, one.reading)
    for way in one.ways:
        source = one.source(way)
        as_float = lambda what, change, source=source: source.like(  # noqa: E731
            both(change, put(key, Tensor.float)), 1e-5 * one.near
        )
        yield source.target("reading", (BROKEN | d.SHAPES).each(change), None, key)
        yield source.target("another type", TYPES.each(change), None, key, rights=as_float)
        much = lambda what, change, source=source: partial(large, source, change)  # noqa: E731
        yield source.target("large reading", LARGE.each(change), None, key, rights=much)
        hidden = HIDDEN.each(lambda value: both(unobserved(*AT), put(key, spoiled(AT, value))))
        yield source.target("masked", hidden, source.like(unobserved(*AT)), key)
        masks = (MASKS | WIDE_MASK).each(partial(put, "observed"))
        yield source.target("mask", masks, source.like(), "observed", rights={"too wide": None})


def poke(place: int, value: float) -> Change:
    """Returns a number in a belief's entry, of the first row."""
    return lambda entry: torch.cat([spoiled(place / 41, value)(entry[:1]), entry[1:]])


NUMBERS = d.Wrong(
    {"a NaN": (0, NAN), "inf": (0, INF)},
    d.drawn(st.tuples(st.integers(0, 40), st.sampled_from([NAN, INF]))),  # -inf is a particle's weight of zero
).each(lambda one: poke(*one))


def beliefs(one: Fed) -> Iterator[Target]:
    """Runs steps from damaged beliefs; correct if the filter does not read the damaged entry."""

    def made() -> Filter:
        torch.manual_seed(0)
        return one.make()

    @cache
    def sound() -> TensorDict:
        row = one.frames()[:, 1].exclude("is_init")
        torch.manual_seed(3)
        return row.update(made().initialise(row.copy()).select(*made().carry_keys))

    def read(row: TensorDict) -> TensorDict:
        filter = made()
        torch.manual_seed(4)
        with torch.no_grad():
            return filter.step(row).select(*filter.belief_keys)

    source = Source(one.border, sound, read, f"{one.name}, belief ")
    for key in made().carry_keys:
        wrong = d.SHAPES.but("too narrow", "a dimension more")
        wrong |= NUMBERS if key[-1] != "age" else {}  # an age counts steps, and is no floating number
        wrong |= TYPES.but("float16") if one.types else {}
        words = (key,) if isinstance(key, str) else (key[-1], str(key))
        yield source.target(f"{key}", wrong.each(partial(put, key)), source.like(), words)


Use = Callable[[Any, TensorDict], Any]
SEQUENCES: dict[str, tuple[tuple[str, ...], Use]] = {
    "a sequence without time": (("batch", "time", "batch_size"), lambda f, x: f.sequence(x[0, 0])),
    "a sequence of no steps": (("step", "time", "batch_size"), lambda f, x: f.sequence(x[:, :0])),
    "keep names nothing": (("keep",), lambda f, x: f.sequence(x, keep=["nothing"])),
    "detach_every zero": (("detach_every",), lambda f, x: f.sequence(x, detach_every=0)),
}
NOWHERE = ("noise", "nowhere")


def _unmarked(filter: Filter, frames: TensorDict) -> Any:
    episodes = torch.arange(B)[:, None].expand(B, T)
    return DEnKFTransform(filter)(frames.exclude("is_init").set("episode", episodes).reshape(-1))


LAYOUTS: dict[str, tuple[tuple[str, ...], Use]] = {
    **SEQUENCES,
    "detach_every negative": (("detach_every",), lambda f, x: f.sequence(x, detach_every=-2)),
    "a step before initialise": (("belief", "initialise"), lambda f, x: f.step(x[:, 0].exclude("is_init"))),
    "without names nothing": (("without",), lambda f, x: f.step(f.initialise(x[:, 0]), without=["nothing"])),
    "without as text": (("without",), lambda f, x: f.step(f.initialise(x[:, 0]), without="observation")),
    "noise of no module": (NOWHERE, lambda f, x: f.sequence(x.set(NOWHERE, torch.zeros(B, T, 2)))),
    "chunk negative": (("chunk",), lambda f, x: f.compile(chunk=-1)),
    "chunk a fraction": (("chunk",), lambda f, x: f.compile(chunk=1.5)),
    "flat slices without marks": (("is_init", "SliceSampler", "sequence", "episode"), _unmarked),
    "diagnostics that are not written": (("diagnostics",), lambda f, x: DEnKFTransform(f, diagnostics=["nothing"])),
    "a transform of no filter": (("Filter", "filter"), lambda f, x: DEnKFTransform(torch.nn.Linear(2, 2))),
    "a packaged step with gradients": (("packaged",), lambda f, x: DEnKFTransform(f, packaged=f, no_grad=False)),
}


def laid_out(one: Fed, layouts: dict[str, tuple[tuple[str, ...], Use]]) -> Iterator[Target]:
    """Yields frames and calls of a wrong layout."""
    for what, (words, use) in layouts.items():
        read = lambda frames, use=use: use(one.make(), frames)  # noqa: E731
        yield Source(one.border, one.frames, read, one.name).target(
            f", layout, {what}", lambda frames: None, None, words
        )


def targets() -> Iterator[Target]:
    """Yields all entries of filters and smoothers."""
    for one in (*FILTERS.values(), *SMOOTHERS, *LAGGED):
        yield from readings(one)
    for one in (*FILTERS.values(), *LAGGED):
        yield from beliefs(one)
    for one in FILTERS.values():
        source, change = one.source("transform that rejects"), partial(put, one.reading)
        rights = lambda what, change, one=one, source=source: partial(goes_on, source, one.width, change)  # noqa: E731
        yield source.target("reading", (BROKEN | LARGE).but().each(change), None, one.reading, rights=rights)
    for one in SMOOTHERS + LAGGED:
        yield from laid_out(one, SEQUENCES)
    for one in LAGGED:
        for way in ("step", "transform"):
            wrong = (BROKEN | d.SHAPES).but().each(partial(put, "observation"))
            yield one.source(way).target("reading", wrong, None, "observation")
    yield from laid_out(ENSEMBLE, LAYOUTS)
    flags = d.Wrong({"float": Tensor.float, "too wide": lambda value: value.expand(B, T, 3)})
    source = ENSEMBLE.source("sequence")
    yield source.target("is_init", flags.each(partial(put, "is_init")), source.like(), "is_init")
