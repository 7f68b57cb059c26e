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
from benchmarks.reliability.borders import legged
from benchmarks.reliability.damage import INF, NAN, Change, put, spoiled
from benchmarks.reliability.soaks.steps import EXACT, SAMPLED
from benchmarks.reliability.target import Source, Target
from tests.borders.around_filters import iterated, particles
from tests.diagnosis.noises_for_tests import Given, attitude, filter_of, sound_frames
from tests.filters.composed import ReplayedFrames
from tests.filters.factories import linear_denkf, linear_kalman, toy_denkf
from tests.filters.test_hidden_numbers import SPACES, make
from torch_denkf.diagnosis import evaluate
from torch_denkf.filters import Filter
from torch_denkf.functional.manifolds import Circle, Euclidean, Product, places_of
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


def _of_filters() -> Iterator[Target]:
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


# ------------------------------------------------------------------------------------------------------------ spaces

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


def _of_spaces() -> Iterator[Target]:
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


# ------------------------------------------------------------------------------------------------------------ noises

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


def _of_noises() -> Iterator[Target]:
    """R and Q, shown and hidden and rejected; times, quaternions and rates that are none."""
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


# ----------------------------------------------------------------------------------------------------- legged robots

_LOG = d.broken(0, 2, places=st.tuples(st.just(0), st.integers(0, legged.T - 1), st.integers(0, 2)))
_LOG = d.SHAPES.but("a dimension more") | _LOG | {"first row nan": spoiled((0, 0, 0), NAN)}
_FLAGS = d.SHAPES.but("a dimension more") | MASKS.but("without its last dimension")
_FLAGS |= {"nan": lambda mask: mask.float() * NAN}
_TIMES = d.SHAPES.but("a dimension more", "too narrow")
_TIMES |= d.of(NAN, INF, 0.0, -0.01).each(lambda value: spoiled((0, 2, 0), value))
READ = {**dict.fromkeys(("imu", "joints", "joint_rates"), _LOG), "contact": _FLAGS, "dt": _TIMES}


def _of_robots() -> Iterator[Target]:
    """Returns readings of filters of legged robots, rows that networks learn from, and arguments of environments."""
    for kind in ("EKF", "UKF", "DEnKF"):
        source = Source("legged robots", legged.log, partial(legged.run, kind), f"{kind} reads ")
        right = source.like(near=1e-4)
        for key, wrong in READ.items():
            rights = {"float": right, "int64": right}
            yield source.target(key, wrong.each(partial(put, key)), None, (key, "legs"), rights=rights)
            if key != "contact":
                yield source.target(f"{key} in another type", put(key, Tensor.double), right, key)
    source = Source("legged robots", legged.lasting_log, legged.learned_loss, "LearnedContacts learns from ")
    learns: dict[Any, d.Wrong] = {("last", key): wrong for key, wrong in READ.items() if key != "dt"}
    for key, wrong in {("true", "velocity"): _LOG, **learns}.items():
        rights = {"float": source.like(), "int64": source.like()}
        yield source.target("/".join(key), wrong.each(partial(put, key)), None, key[-1], rights=rights)
    wrong = d.SHAPES.but("a dimension more", "without its last dimension").each(partial(put, "action"))
    wrong |= {f"{value}": put("action", lambda action, value=value: action + value) for value in (NAN, INF)}
    act = Source("legged robots", legged.standing, legged.acted, "LeggedEnv takes ")
    yield act.target("an action", wrong, None, "action")


def targets() -> Iterator[Target]:
    """Yields all that is read, entry by entry."""
    for kind in (_of_filters, _of_spaces, _of_noises, _of_robots):
        yield from kind()
