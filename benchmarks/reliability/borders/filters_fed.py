"""What filters read: in a step, in a sequence, and in an environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

from benchmarks.reliability.case import Case
from benchmarks.reliability.damage import finite, leaves, same
from tests.filters.composed import ReplayedFrames
from tests.filters.factories import linear_denkf, linear_kalman, toy_denkf
from tests.filters.gaussian_for_tests import linear_filter
from tests.filters.particle_for_tests import bootstrap
from torch_denkf.filters import Filter, LSTMFilter
from torch_denkf.transforms import DEnKFTransform

B, T = 3, 4
AT = (1, 2)  # row and time that are damaged


@dataclass(frozen=True)
class Subject:
    """A filter, and the entry that it reads."""

    name: str
    make: Callable[[], Filter]
    reading: str = "observation"
    width: int = 2
    action: bool = False


def _lstm() -> Filter:
    return LSTMFilter(None, observation_dim=2, state_dim=2, observation_key="observation", hidden_size=8)


SUBJECTS = (
    Subject("KalmanFilter", linear_kalman),
    Subject("EKF", partial(linear_filter, "EKF")),
    Subject("UKF", partial(linear_filter, "UKF")),
    Subject("BackpropKF", partial(linear_filter, "BackpropKF")),
    Subject("DEnKF, etkf", partial(linear_denkf, "etkf")),
    Subject("DEnKF, sakov", partial(linear_denkf, "sakov")),
    Subject("DEnKF, perturbed", partial(linear_denkf, "perturbed", noisy=True)),
    Subject("DEnKF, learned", toy_denkf, "measurement", 4, True),
    Subject("ParticleFilter, systematic", partial(bootstrap, 16)),
    Subject("ParticleFilter, soft", partial(bootstrap, 16, resampling="soft")),
    Subject("ParticleFilter, transport", partial(bootstrap, 16, resampling="transport")),
    Subject("LSTMFilter", _lstm),
)


# ------------------------------------------------------------------------------------------------------ what is run


def _seeded(make: Callable[[], Filter]) -> Filter:
    torch.manual_seed(0)
    return make()


def _frames(subject: Subject) -> TensorDict:
    """Sound frames ``[B, T]``."""
    random = torch.Generator().manual_seed(1)
    frames = TensorDict({subject.reading: torch.randn(B, T, subject.width, generator=random)}, [B, T])
    frames["action"] = torch.randn(B, T, 2, generator=random)
    frames["observed"] = torch.ones(B, T, 1, dtype=torch.bool)
    frames["is_init"] = torch.zeros(B, T, 1, dtype=torch.bool)
    frames["is_init"][:, 0] = True
    return frames


def _stepped(filter: Filter, frames: TensorDict) -> TensorDict:
    """Steps through the frames, as a robot does."""
    torch.manual_seed(2)
    rows = frames.exclude("is_init").unbind(1)
    carry, out = filter.initialise(rows[0].copy()), []
    for row in rows[1:]:
        for key in filter.belief_keys:
            row.set(key, carry.get(key))
        carry = filter.step(row)
        out.append(carry.select(*filter.belief_keys).copy())
    return torch.stack(out, 1)


def _sequence(filter: Filter, frames: TensorDict) -> TensorDict:
    torch.manual_seed(2)
    return filter.sequence(frames.copy()).select(*filter.belief_keys)


def _rollout(filter: Filter, frames: TensorDict, **options: Any) -> TensorDict:
    torch.manual_seed(2)
    inner = ReplayedFrames(frames)
    env = TransformedEnv(inner, DEnKFTransform(filter, **options))
    out = env.rollout(T - 1, inner.player(), break_when_any_done=False)
    return out["next"].select(*filter.belief_keys)


RUNS: dict[str, Callable[[Filter, TensorDict], TensorDict]] = {
    "step": _stepped,
    "sequence": _sequence,
    "transform": _rollout,
}

# --------------------------------------------------------------------------------------------------- what is damaged

Damage = Callable[[Subject, TensorDict], TensorDict]


def _value(value: float, *, whole: bool = False) -> Damage:
    def damage(subject: Subject, frames: TensorDict) -> TensorDict:
        if whole:
            frames[subject.reading][AT] = value
        else:
            frames[subject.reading][AT][..., 0] = value
        return frames

    return damage


def _entry(change: Callable[[Tensor], Tensor | None], key: str | None = None) -> Damage:
    def damage(subject: Subject, frames: TensorDict) -> TensorDict:
        name = key or subject.reading
        changed = change(frames[name])
        return frames.exclude(name) if changed is None else frames.set(name, changed)

    return damage


#: By what is done to the reading.
READINGS: dict[str, Damage] = {
    "a NaN": _value(torch.nan),
    "all NaN": _value(torch.nan, whole=True),
    "inf": _value(torch.inf),
    "-inf": _value(-torch.inf),
    "1e25": _value(1e25),
    "-1e38": _value(-1e38, whole=True),
    "missing": _entry(lambda value: None),
    "too wide": _entry(lambda value: torch.cat([value, value[..., :1]], -1)),
    "too narrow": _entry(lambda value: value[..., :1]),
    "without its last dimension": _entry(lambda value: value[..., 0]),
    "a dimension more": _entry(lambda value: value[..., None].expand(*value.shape, 3)),
    "float64": _entry(lambda value: value.double()),
    "float16": _entry(lambda value: value.half()),
    "int64": _entry(lambda value: value.round().long()),
}

MASKS: dict[str, Damage] = {
    "float": _entry(lambda value: value.float(), "observed"),
    "int64": _entry(lambda value: value.long(), "observed"),
    "too wide": _entry(lambda value: value.expand(*value.shape[:-1], 5), "observed"),
    "without its last dimension": _entry(lambda value: value[..., 0], "observed"),
}


def _damaged(subject: Subject, run: str, damage: Damage, folder: Path) -> TensorDict:
    filter = _seeded(subject.make)
    return RUNS[run](filter, damage(subject, _frames(subject)))


def _reference(subject: Subject, run: str, damage: Damage) -> TensorDict:
    """The result of frames that are right."""
    return _damaged(subject, run, damage, Path())


def _unobserved(subject: Subject, frames: TensorDict) -> TensorDict:
    frames["observed"][AT] = False
    return frames


def _first_unobserved(subject: Subject, frames: TensorDict) -> TensorDict:
    """Only the component that is damaged is hidden."""
    frames["observed"] = frames["observed"].expand(B, T, subject.width).clone()
    frames["observed"][AT][..., 0] = False
    return frames


#: By the width of readings: what may be hidden of one that is damaged. A sensor's is hidden as a whole.
_HIDES = {2: (_unobserved, _first_unobserved), 4: (_unobserved,)}


def _rounded(subject: Subject, frames: TensorDict) -> TensorDict:
    return frames.set(subject.reading, frames[subject.reading].round())


def _sound(subject: Subject, frames: TensorDict) -> TensorDict:
    return frames


def _equals(subject: Subject, run: str, damage: Damage, result: TensorDict, *, tolerance: float = 0.0) -> bool:
    expected = _reference(subject, run, damage)
    return finite(result) and same(result, expected, rtol=tolerance, atol=tolerance)


def _precision(subject: Subject, run: str, result: TensorDict, *, tolerance: float) -> bool:
    """Right where the filter's own precision is kept, and the numbers are those of its readings."""
    kept = all(value.dtype == torch.float32 for value in leaves(result).values() if value.is_floating_point())
    return kept and _equals(subject, run, _sound, result, tolerance=tolerance)


def _large(subject: Subject, run: str, damage: Damage, result: TensorDict) -> bool:
    """Right where a reading is treated as missing, or all is finite and as in double precision."""
    if _equals(subject, run, _unobserved, result):
        return True
    filter = _seeded(subject.make).double()
    frames = damage(subject, _frames(subject))
    frames[subject.reading] = frames[subject.reading].double()
    if run == "transform":
        frames["action"] = frames["action"].double()
    try:
        expected = leaves(RUNS[run](filter, frames))
    except Exception:
        return False
    found = leaves(result)
    for key, value in expected.items():
        size = value[AT[0]].abs().max()
        if not torch.allclose(found[key].double(), value, rtol=1e-3, atol=float(1e-3 * size)):
            return False
    return finite(result)


def _right(subject: Subject, run: str, what: str, damage: Damage) -> Callable[[TensorDict], bool] | None:
    """What a right result is, where one may come out."""
    if what in ("1e25", "-1e38"):
        return partial(_large, subject, run, damage)
    if what == "int64":
        return partial(_equals, subject, run, _rounded, tolerance=1e-6)
    if what in ("float64", "float16"):
        return partial(_precision, subject, run, tolerance=1e-5 if what == "float64" else 1e-2)
    return None


def _hidden(value: float) -> Damage:
    def damage(subject: Subject, frames: TensorDict) -> TensorDict:
        return _value(value, whole=True)(subject, _unobserved(subject, frames))

    return damage


# ------------------------------------------------------------------------------------------------------- the belief


def _carried(subject: Subject, number: int, change: Callable[[Tensor], Tensor | None], folder: Path) -> TensorDict:
    """A step from a damaged belief."""
    filter = _seeded(subject.make)
    torch.manual_seed(3)
    row = _frames(subject)[:, 1].exclude("is_init")
    belief = filter.initialise(row.copy())
    for place, key in enumerate(filter.carry_keys):
        value = belief.get(key)
        value = change(value) if place == number else value
        if value is not None:
            row.set(key, value)
    torch.manual_seed(4)
    return filter.step(row)


def _unharmed(subject: Subject, result: TensorDict) -> bool:
    """Right where the filter does not read what is damaged, as an LSTM does not read its last mean."""
    filter = _seeded(subject.make)
    expected = _carried(subject, -1, lambda value: value, Path())
    return same(result.select(*filter.belief_keys), expected.select(*filter.belief_keys))


def _poke(value: float) -> Callable[[Tensor], Tensor]:
    def change(tensor: Tensor) -> Tensor:
        out = tensor.clone()
        out[0].view(-1)[0] = value
        return out

    return change


CARRIED: dict[str, Callable[[Tensor], Tensor | None]] = {
    "a NaN": _poke(torch.nan),
    "inf": _poke(torch.inf),
    "missing": lambda value: None,
    "too wide": lambda value: torch.cat([value, value[..., :1]], -1),
    "a dimension less": lambda value: value[..., 0],
    "float64": lambda value: value.double(),
    "int64": lambda value: value.long(),
}


def _words(key: Any) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else (key[-1], str(key))


# ------------------------------------------------------------------------------------------------ layout and options


def _act_layout(subject: Subject, act: Callable[[Filter, TensorDict], Any], folder: Path) -> Any:
    return act(_seeded(subject.make), _frames(subject))


LAYOUTS: dict[str, tuple[tuple[str, ...], Callable[[Filter, TensorDict], Any]]] = {
    "a sequence without time": (("batch", "time", "batch_size"), lambda f, x: f.sequence(x[0, 0])),
    "a sequence of no steps": (("step", "time", "batch_size"), lambda f, x: f.sequence(x[:, :0])),
    "a step before initialise": (("belief", "initialise"), lambda f, x: f.step(x[:, 0].exclude("is_init"))),
    "is_init as float": (("is_init",), lambda f, x: f.sequence(x.set("is_init", x["is_init"].float()))),
    "is_init too wide": (("is_init",), lambda f, x: f.sequence(x.set("is_init", x["is_init"].expand(B, T, 3)))),
    "keep names nothing": (("keep",), lambda f, x: f.sequence(x, keep=["nothing"])),
    "without names nothing": (("without",), lambda f, x: f.step(f.initialise(x[:, 0]), without=["nothing"])),
    "without as text": (("without",), lambda f, x: f.step(f.initialise(x[:, 0]), without="observation")),
    "detach_every zero": (("detach_every",), lambda f, x: f.sequence(x, detach_every=0)),
    "detach_every negative": (("detach_every",), lambda f, x: f.sequence(x, detach_every=-2)),
    "noise of no module": (
        ("noise", "nowhere"),
        lambda f, x: f.sequence(x.set(("noise", "nowhere"), torch.zeros(B, T, 2))),
    ),
    "chunk negative": (("chunk",), lambda f, x: f.compile(chunk=-1)),
    "chunk a fraction": (("chunk",), lambda f, x: f.compile(chunk=1.5)),
    "flat slices without marks": (
        ("is_init", "SliceSampler", "sequence", "episode"),
        lambda f, x: DEnKFTransform(f)(
            x.exclude("is_init").set("episode", torch.arange(B)[:, None].expand(B, T)).reshape(-1)
        ),
    ),
    "diagnostics that are not written": (("diagnostics",), lambda f, x: DEnKFTransform(f, diagnostics=["nothing"])),
    "a transform of no filter": (("Filter", "filter"), lambda f, x: DEnKFTransform(torch.nn.Linear(2, 2))),
    "a packaged step with gradients": (("packaged",), lambda f, x: DEnKFTransform(f, packaged=f, no_grad=False)),
}
#: Layouts that a filter may also get right: as when the flag was boolean, or read no flag at all.
MAY_BE_RIGHT = {"is_init as float", "is_init too wide"}


def cases() -> Iterator[Case]:
    """All damaged readings, masks, beliefs and layouts."""
    border = "readings"
    for subject in SUBJECTS:
        words = (subject.reading,)
        for run in RUNS:
            for what, damage in READINGS.items():
                right = _right(subject, run, what, damage)
                act = partial(_damaged, subject, run, damage)
                yield Case(border, f"{subject.name}, {run}: reading {what}", words, act, right)
            for value in (torch.nan, torch.inf, 1e38):
                right = partial(_equals, subject, run, _unobserved)
                act = partial(_damaged, subject, run, _hidden(value))
                yield Case(border, f"{subject.name}, {run}: {value} where the mask says missing", words, act, right)
            for what, damage in MASKS.items():
                right = (
                    partial(_equals, subject, run, _sound)
                    if what in ("float", "int64", "without its last dimension")
                    else None
                )
                act = partial(_damaged, subject, run, damage)
                yield Case(border, f"{subject.name}, {run}: mask {what}", ("observed",), act, right)
        for number, key in enumerate(_seeded(subject.make).carry_keys):
            for what, change in CARRIED.items():
                act = partial(_carried, subject, number, change)
                yield Case(
                    border, f"{subject.name}: belief {key} {what}", _words(key), act, partial(_unharmed, subject)
                )
    subject = SUBJECTS[4]
    for what, (words, act) in LAYOUTS.items():
        right = partial(_equals, subject, "sequence", _sound) if what in MAY_BE_RIGHT else None
        if right is not None:
            run = act
            act = lambda f, x, run=run: run(f, x).select(*f.belief_keys)  # noqa: E731
        yield Case(border, what, words, partial(_act_layout, subject, act), right)
    yield from _rejecting()


def _rejecting() -> Iterator[Case]:
    """A transform that goes on where a reading is broken."""
    for subject in SUBJECTS:
        for what in ("a NaN", "all NaN", "inf", "1e25", "-1e38"):
            damage = READINGS[what]

            def act(folder: Path, subject: Subject = subject, damage: Damage = damage) -> TensorDict:
                return _rollout(_seeded(subject.make), damage(subject, _frames(subject)), check_finite=False)

            right = partial(_goes_on, subject, damage)
            yield Case(
                "readings",
                f"{subject.name}, transform without check_finite: reading {what}",
                (subject.reading,),
                act,
                right,
            )


def _goes_on(subject: Subject, damage: Damage, result: TensorDict) -> bool:
    """Right where only the row that is damaged is as if it had not been observed, or computed right."""
    rows = [row for row in range(B) if row != AT[0]]
    expected = [_reference(subject, "transform", hide) for hide in _HIDES[subject.width]]
    others = _reference(subject, "transform", _sound)
    near = {"rtol": 1e-5, "atol": 1e-5}
    hidden = any(same(result[AT[0]], hidden[AT[0]], **near) for hidden in expected) or _large(
        subject, "transform", damage, result
    )
    return finite(result) and hidden and same(result[rows], others[rows], **near)
