"""Damages what filters and smoothers read: in a step, in a sequence, and in an environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import finite, leaves, same
from benchmarks.reliability.target import Target
from tests.filters.composed import ReplayedFrames
from tests.filters.factories import linear_denkf, linear_kalman, toy_denkf
from tests.filters.gaussian_for_tests import linear_filter
from tests.filters.particle_for_tests import bootstrap
from torch_denkf.baselines import LSTMFilter
from torch_denkf.filters import Filter
from torch_denkf.imperfect import RejectReadings
from torch_denkf.imperfect.rejection import OnBad
from torch_denkf.transforms import DEnKFTransform

B, T = 3, 4
AT = (1, 2)  # row and time that are damaged
NAN, INF = float("nan"), float("inf")


@dataclass(frozen=True)
class Fed:
    """A filter or a smoother, and the entry that it reads.

    Args:
        name: for the record.
        make: makes it.
        runs: how it is run.
        reading: the entry.
        width: its width.
        near: a factor of the tolerances of what is rounded.
        types: whether its belief may also come in other types.
    """

    name: str
    make: Callable[[], Any]
    runs: tuple[str, ...] = ("step", "sequence", "transform")
    reading: str = "observation"
    width: int = 2
    near: float = 1.0
    types: bool = True

    def seeded(self) -> Any:
        """Makes the same one each time."""
        torch.manual_seed(0)
        return self.make()

    def frames(self) -> TensorDict:
        """Sound frames ``[B, T]``."""
        random = torch.Generator().manual_seed(1)
        frames = TensorDict({self.reading: torch.randn(B, T, self.width, generator=random)}, [B, T])
        frames["action"] = torch.randn(B, T, 2, generator=random)
        frames["observed"] = torch.ones(B, T, 1, dtype=torch.bool)
        frames["is_init"] = torch.zeros(B, T, 1, dtype=torch.bool)
        frames["is_init"][:, 0] = True
        return frames

    def run(self, run: str, change: Change) -> TensorDict:
        """Returns what comes of damaged frames."""
        return RUNS[run](self.seeded(), change(self, self.frames()))


def _lstm() -> Filter:
    return LSTMFilter(None, observation_dim=2, state_dim=2, observation_key="observation", hidden_size=8)


FILTERS = (
    Fed("KalmanFilter", linear_kalman),
    Fed("EKF", partial(linear_filter, "EKF")),
    Fed("UKF", partial(linear_filter, "UKF")),
    Fed("BackpropKF", partial(linear_filter, "BackpropKF")),
    Fed("DEnKF, etkf", partial(linear_denkf, "etkf")),
    Fed("DEnKF, sakov", partial(linear_denkf, "sakov")),
    Fed("DEnKF, perturbed", partial(linear_denkf, "perturbed", noisy=True)),
    Fed("DEnKF, learned", toy_denkf, reading="measurement", width=4),
    Fed("ParticleFilter, systematic", partial(bootstrap, 16)),
    Fed("ParticleFilter, soft", partial(bootstrap, 16, resampling="soft")),
    Fed("ParticleFilter, transport", partial(bootstrap, 16, resampling="transport")),
    Fed("LSTMFilter", _lstm),
)


# ------------------------------------------------------------------------------------------------------ what is run


def _stepped(filter: Filter, frames: TensorDict) -> TensorDict:
    """Steps through the frames, as a robot does."""
    torch.manual_seed(2)
    rows = frames.exclude("is_init").unbind(1)
    carry, out, check = filter.initialise(rows[0].copy()), [], _front(filter, "raise")
    for row in rows[1:]:
        for key in filter.belief_keys:
            row.set(key, carry.get(key))
        carry = filter.step(check(row))
        out.append(carry.select(*filter.belief_keys).copy())
    return torch.stack(out, 1)


def _front(filter: Any, on_bad: OnBad) -> RejectReadings:
    """Returns the module in front of a filter that checks its readings."""
    reading = "measurement" if "measurement" in getattr(filter, "in_keys", ()) else "observation"
    return RejectReadings({reading: "observed"}, on_bad=on_bad)


def _sequence(filter: Filter, frames: TensorDict) -> TensorDict:
    torch.manual_seed(2)
    return filter.sequence(_front(filter, "raise")(frames.copy())).select(*filter.belief_keys)


def _smoothed(smoother: Any, frames: TensorDict) -> TensorDict:
    torch.manual_seed(2)
    keys = getattr(smoother, "smoothed_keys", None) or [key for key in smoother.out_keys if key[0] == "smoothed"]
    return smoother.sequence(_front(smoother, "raise")(frames.copy())).select(*keys)


def _rollout(filter: Filter, frames: TensorDict, on_bad: OnBad = "raise") -> TensorDict:
    torch.manual_seed(2)
    inner = ReplayedFrames(frames)
    env = TransformedEnv(inner, Compose(_front(filter, on_bad), DEnKFTransform(filter)))
    out = env.rollout(T - 1, inner.player(), break_when_any_done=False)
    return out["next"].select(*filter.belief_keys)


RUNS: dict[str, Callable[[Any, TensorDict], TensorDict]] = {
    "step": _stepped,
    "sequence": _sequence,
    "transform": _rollout,
    "smoothed": _smoothed,
    "transform that rejects": partial(_rollout, on_bad="mask"),
}

# ----------------------------------------------------------------------------------------------------- what is right

Change = Callable[[Fed, TensorDict], TensorDict]


@dataclass(frozen=True)
class Damage:
    """Changes frames, and judges a result, given whom they were fed to, how, and what was done."""

    change: Change
    right: Callable[[Fed, str, Damage, TensorDict], bool] | None = None


def _sound(fed: Fed, frames: TensorDict) -> TensorDict:
    return frames


def _rounded(fed: Fed, frames: TensorDict) -> TensorDict:
    return frames.set(fed.reading, frames[fed.reading].round())


def _halved(fed: Fed, frames: TensorDict) -> TensorDict:
    return frames.set(fed.reading, frames[fed.reading].half().float())


def _unobserved(fed: Fed, frames: TensorDict) -> TensorDict:
    frames["observed"][AT] = False
    return frames


def _first_unobserved(fed: Fed, frames: TensorDict) -> TensorDict:
    """Only the component that is damaged is hidden."""
    frames["observed"] = frames["observed"].expand(B, T, fed.width).clone()
    frames["observed"][AT][..., 0] = False
    return frames


#: By the width of readings: what may be hidden of one that is damaged. A sensor's is hidden as a whole.
HIDES = {2: (_unobserved, _first_unobserved), 4: (_unobserved,)}


def as_of(change: Change, *, tolerance: float = 0.0, precision: bool = False) -> Callable[..., bool]:
    """Right where a result is that of other frames, in the filter's own precision if that is asked for."""

    def right(fed: Fed, run: str, damage: Any, result: TensorDict) -> bool:
        near = tolerance * fed.near
        numbers = [value for value in leaves(result).values() if value.is_floating_point()]
        kept = not precision or all(value.dtype == torch.float32 for value in numbers)
        return kept and finite(result) and same(result, fed.run(run, change), rtol=near, atol=near)

    return right


def large(fed: Fed, run: str, damage: Damage, result: TensorDict) -> bool:
    """Right where a reading is treated as missing, or all is finite and as in double precision."""
    if as_of(_unobserved)(fed, run, damage, result):
        return True
    frames = damage.change(fed, fed.frames())
    frames[fed.reading] = frames[fed.reading].double()
    if run.startswith("transform"):
        frames["action"] = frames["action"].double()
    try:
        expected = leaves(RUNS[run](fed.seeded().double(), frames))
    except Exception:
        return False
    found = leaves(result)
    return finite(result) and all(
        torch.allclose(found[key].double(), value.double(), rtol=1e-3, atol=1e-3 * float(value[AT[0]].abs().max()))
        for key, value in expected.items()
    )


def goes_on(fed: Fed, run: str, damage: Damage, result: TensorDict) -> bool:
    """Right where only the row that is damaged is as if it had not been observed, or computed right."""
    rows = [row for row in range(B) if row != AT[0]]
    near = {"rtol": 1e-5, "atol": 1e-5}
    hidden = any(same(result[AT[0]], fed.run("transform", hide)[AT[0]], **near) for hide in HIDES[fed.width])
    others = same(result[rows], fed.run("transform", _sound)[rows], **near)
    return finite(result) and others and (hidden or large(fed, "transform", damage, result))


# --------------------------------------------------------------------------------------------------- what is damaged


def value(number: float, place: Any = 0, at: tuple[int, int] = AT, right: Any = None) -> Damage:
    """A number in a reading."""

    def change(fed: Fed, frames: TensorDict) -> TensorDict:
        frames[fed.reading][at][..., place] = number
        return frames

    return Damage(change, right)


def entry(change: Callable[[Tensor], Tensor | None], right: Any = None, key: str = "") -> Damage:
    """A changed entry, by default the reading; ``None`` takes it away."""

    def damage(fed: Fed, frames: TensorDict) -> TensorDict:
        name = key or fed.reading
        changed = change(frames[name])
        return frames.exclude(name) if changed is None else frames.set(name, changed)

    return Damage(damage, right)


def hidden(number: float) -> Damage:
    """A number that the mask hides."""
    return Damage(
        lambda fed, frames: value(number, slice(None)).change(fed, _unobserved(fed, frames)), as_of(_unobserved)
    )


ALL = slice(None)
DTYPES = {"float64": torch.float64, "float16": torch.float16, "int64": torch.int64}
SHAPES: dict[str, Callable[[Tensor], Tensor | None]] = {
    "missing": lambda value: None,
    "too wide": lambda value: torch.cat([value, value[..., :1]], -1),
    "without its last dimension": lambda value: value[..., 0],
}
PLACES = st.tuples(st.integers(0, B - 1), st.integers(1, T - 1))
SIGNED = st.floats(1e20, 3e38) | st.floats(-3e38, -1e20)
BROKEN = d.Wrong({"a NaN": value(NAN), "all NaN": value(NAN, ALL), "inf": value(INF)})
READINGS = BROKEN | d.Wrong(
    {
        "-inf": value(-INF),
        "1e25": value(1e25, right=large),
        "-1e38": value(-1e38, ALL, right=large),
        "too narrow": entry(lambda value: value[..., :1]),
        "a dimension more": entry(lambda value: value[..., None].expand(*value.shape, 3)),
        "float64": entry(Tensor.double, as_of(_sound, tolerance=1e-5, precision=True)),
        "float16": entry(Tensor.half, as_of(_halved, tolerance=1e-6, precision=True)),
        "int64": entry(lambda value: value.round().long(), as_of(_rounded, tolerance=1e-6)),
        **{what: entry(change) for what, change in SHAPES.items()},
    },
    st.builds(
        lambda number, place, at: (f"{number} in component {place} at {at}", value(number, place, at)),
        st.sampled_from([NAN, INF, -INF]),
        st.integers(0, 1),
        PLACES,
    )
    | SIGNED.map(lambda number: (f"{number}", value(number, right=large))),
)
MASKED = d.Wrong(
    {"nan": hidden(NAN), "inf": hidden(INF), "1e38": hidden(1e38)},
    st.floats(width=32).map(lambda number: (f"{number}", hidden(number))),
)
MASKS = d.Wrong(
    {
        "float": entry(Tensor.float, as_of(_sound), "observed"),
        "int64": entry(Tensor.long, as_of(_sound), "observed"),
        "without its last dimension": entry(lambda value: value[..., 0], as_of(_sound), "observed"),
        "too wide": entry(lambda value: value.expand(*value.shape[:-1], 5), None, "observed"),
    }
)
GOES_ON = d.Wrong(
    {
        **{what: Damage(damage.change, goes_on) for what, damage in BROKEN.named.items()},
        "1e25": value(1e25, right=goes_on),
        "-1e38": value(-1e38, ALL, right=goes_on),
    }
)


def poke(number: float, place: int = 0) -> Callable[[Tensor], Tensor]:
    """A number in a belief's entry."""

    def change(tensor: Tensor) -> Tensor:
        out = tensor.clone()
        flat = out[0].view(-1)
        flat[place % len(flat)] = number
        return out

    return change


CARRIED = d.Wrong(
    {"missing": SHAPES["missing"], "too wide": SHAPES["too wide"], "a dimension less": lambda v: v[..., 0]}
)
NUMBERS = d.Wrong(
    {"a NaN": poke(NAN), "inf": poke(INF)},
    st.builds(
        lambda number, place: (f"{number} in place {place}", poke(number, place)),
        st.sampled_from([NAN, INF]),  # -inf is a particle's weight of zero
        st.integers(0, 40),
    ),
)
OTHER_TYPES = d.Wrong({"float64": Tensor.double, "int64": Tensor.long})


def step_from(fed: Fed, number: int, change: Callable[[Tensor], Tensor | None], folder: Path | None = None) -> Any:
    """A step from a damaged belief."""
    filter = fed.seeded()
    torch.manual_seed(3)
    row = fed.frames()[:, 1].exclude("is_init")
    belief = filter.initialise(row.copy())
    for place, key in enumerate(filter.carry_keys):
        value = belief.get(key)
        value = change(value) if place == number else value
        if value is not None:
            row.set(key, value)
    torch.manual_seed(4)
    return filter.step(row)


def unharmed(fed: Fed, result: TensorDict) -> bool:
    """Right where the filter does not read what is damaged, as an LSTM does not read its last mean."""
    keys = fed.seeded().belief_keys
    return same(result.select(*keys), step_from(fed, -1, lambda value: value).select(*keys))


# ------------------------------------------------------------------------------------------------ layout and options

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
#: That a filter may also get right: as when the flag was boolean, or read no flag at all.
FLAGS = d.Wrong(
    {
        "float": entry(Tensor.float, as_of(_sound), "is_init"),
        "too wide": entry(lambda value: value.expand(B, T, 3), as_of(_sound), "is_init"),
    }
)


def fed_with(border: str, fed: Fed, run: str, name: str, wrong: d.Wrong, word: str = "") -> Target:
    """Damaged frames in one run."""
    act = lambda damage, folder: fed.run(run, damage.change)  # noqa: E731
    rights = lambda what, damage: damage.right and partial(damage.right, fed, run, damage)  # noqa: E731
    return Target(border, f"{fed.name}, {run}, {name}", (word or fed.reading,), act, wrong, rights=rights)


def laid_out(border: str, fed: Fed, layouts: dict[str, tuple[tuple[str, ...], Use]]) -> Iterator[Target]:
    """Frames and calls of a wrong layout."""
    for what, (words, use) in layouts.items():
        act = lambda use, folder: use(fed.seeded(), fed.frames())  # noqa: E731
        yield Target(border, f"{fed.name}, layout, {what}", words, act, d.Wrong({"damaged": use}))


def carried(border: str, fed: Fed) -> Iterator[Target]:
    """Damaged beliefs."""
    for number, key in enumerate(fed.seeded().carry_keys):
        wrong = CARRIED | NUMBERS if key[-1] != "age" else CARRIED  # an age counts steps, and is no floating number
        wrong = wrong | OTHER_TYPES if fed.types else wrong
        words = (key,) if isinstance(key, str) else (key[-1], str(key))
        yield Target(
            border, f"{fed.name}, belief {key}", words, partial(step_from, fed, number), wrong, partial(unharmed, fed)
        )


def everything(border: str, fed: Fed) -> Iterator[Target]:
    """Damaged readings and masks in every run."""
    for run in fed.runs:
        yield fed_with(border, fed, run, "reading", READINGS)
        yield fed_with(border, fed, run, "masked", MASKED)
        yield fed_with(border, fed, run, "mask", MASKS, "observed")


def targets() -> Iterator[Target]:
    """Readings, masks, beliefs and layouts of filters."""
    for fed in FILTERS:
        yield from everything("readings", fed)
        yield from carried("readings", fed)
        yield fed_with("readings", fed, "transform that rejects", "reading", GOES_ON)
    yield from laid_out("readings", FILTERS[4], LAYOUTS)
    yield fed_with("readings", FILTERS[4], "sequence", "is_init", FLAGS, "is_init")
