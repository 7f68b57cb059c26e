"""Legged robots: their models, noises and errors, what their filters read, and simulated ones."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from dataclasses import fields
from functools import cache, partial
from typing import Any

import mujoco
import torch
from hypothesis import strategies as st
from tensordict import TensorDict
from torch import Tensor
from torchrl.envs import TransformedEnv

from benchmarks.reliability import damage as d
from benchmarks.reliability.target import Subject, Target, targets_of
from torch_denkf.applications.legged import (
    LearnedContacts,
    LeggedErrors,
    LeggedNoises,
    contacts,
    humanoid,
    legged_filter,
    quadruped,
)
from torch_denkf.applications.legged.environment import LeggedEnv
from torch_denkf.applications.legged.kinematics import LegKinematics
from torch_denkf.applications.legged.learned import last_rows, with_last_rows
from torch_denkf.imperfect import RejectReadings

BORDER, T, JOINTS, FEET = "legged robots", 5, 4, ["left", "right"]
NAN, INF = float("nan"), float("inf")
NAMES: dict[str, Any] = {"feet": FEET, "imu": "imu"}
KEYS = ("imu", "joints", "joint_rates", "contact")
_LEG = """<body pos="0 {y} 0"><joint name="{side}_hip" axis="0 1 0" damping="2"/><geom size=".05"/><body pos="0 0 -.2">
  <joint name="{side}_knee" type="slide" axis="0 0 1" range="-.1 .1" damping="20" stiffness="400"/><geom size=".05"/>
  <site name="{side}" pos="0 0 -.2"/></body></body>"""
_ROBOT = f"""<mujoco><option timestep=".0025"/><worldbody><geom type="plane" size="9 9 1"/>
  <body name="base" pos="0 0 .6"><freejoint/><geom type="box" size=".2 .2 .05"/>
  <site name="imu" pos=".1 .05 .02" euler="10 20 30"/>
  {"".join(_LEG.format(side=side, y=y) for side, y in zip(FEET, (-0.2, 0.2), strict=True))}</body></worldbody>
  <actuator><motor joint="left_hip" ctrlrange="-1 1" ctrllimited="true"/></actuator>
  <sensor><accelerometer site="imu"/></sensor></mujoco>"""


@cache
def model() -> mujoco.MjModel:
    """A robot of two legs, each with a hinge and a slide."""
    return mujoco.MjModel.from_xml_string(_ROBOT)


@cache
def log() -> TensorDict:
    """Returns the readings of a robot that stands and sways."""
    random = torch.Generator().manual_seed(0)
    turn = 0.01 * torch.randn(1, T, 3, generator=random)
    force = torch.tensor([0.0, 0.0, 9.81]) + 0.1 * torch.randn(1, T, 3, generator=random)
    rows = TensorDict({"imu": torch.cat([turn, force], -1), "dt": torch.full((1, T, 1), 0.01)}, [1, T])
    rows["joints"], rows["joint_rates"] = 0.1 * torch.randn(2, 1, T, JOINTS, generator=random)
    rows["contact"] = torch.ones(1, T, 2, dtype=torch.bool)
    rows["true"] = TensorDict({"velocity": torch.zeros(1, T, 3)}, [1, T])
    return rows


# -------------------------------------------------------------------------------------------------------- arguments

NAME = d.of("tail", 3, None, "")
FOOT_NAMES = d.of(["left", "tail"], "left", [1, 2], [], ["left"] * 2)
JOINT_NAMES = d.of(
    ["left_hip", "left_knee", "right_hip", "tail"],
    ["left_hip", "left_knee"],
    ["left_hip", "left_knee", "right_hip", "right_knee", "left_hip"],
    "left_hip",
    [0, 1, 2, 3],
)
MODEL = d.Wrong({"nothing": None, "text": "robot.xml", "a module": torch.nn.Linear(1, 1)})
OTHERS = d.of(0.1, "none", {"gyro": 0.1})
ROBOT: dict[str, d.Wrong | None] = {"model": MODEL, "feet": FOOT_NAMES, "imu": NAME}
SEED = d.of("x", 0.5, -1)


def _rolled(env: Any) -> Any:
    return env.rollout(3)


def _filtered(filter: Any, rows: TensorDict | None = None) -> TensorDict:
    torch.manual_seed(0)
    rows = (log() if rows is None else rows).clone()
    with torch.no_grad():
        rows = RejectReadings(dict.fromkeys(KEYS[:3], "contact"), on_bad="raise")(rows)
        return filter.sequence(rows).select(*filter.belief_keys)


def _of_last(made: LearnedContacts) -> Tensor:
    return made(with_last_rows(log(), made.rows))["legs", "moves"]


def _kept(made: Any) -> TensorDict:
    return TransformedEnv(LeggedEnv(model(), **NAMES), made).rollout(2)


def _subjects() -> Iterator[Subject]:
    kept = dict.fromkeys(("rows", "every"), d.COUNT)
    env = {
        **ROBOT,
        "dt": d.POSITIVE | {"no multiple": 0.0033},
        "errors": OTHERS | {"noises": LeggedNoises()},
        "on": d.FINITE | {"below the other": 5.0},
        "off": d.FINITE | {"above the other": 50.0},
        "pushes": d.NOT_NEGATIVE,
        "seed": SEED,
    }
    whole = {
        **ROBOT,
        "joints": JOINT_NAMES,
        "kind": d.CHOICE,
        "threshold": d.POSITIVE,
        "noises": OTHERS | {"errors": LeggedErrors()},
        "contacts": OTHERS | {"a module": torch.nn.Linear(1, 1)},
        "gravity": d.FINITE | {"nothing": None},
    }
    learned = {**ROBOT, "joints": JOINT_NAMES, "rows": d.COUNT, "rate": d.POSITIVE, "lasts": d.POSITIVE | {"less": 0.5}}
    forces = d.of("much", 3.0, torch.ones(2), torch.full((3, 2), NAN))
    before = d.of(torch.ones(2), torch.ones(3, dtype=torch.bool), "all")
    threshold = {"on": d.FINITE | {"below the other": 5.0}, "off": d.FINITE | {"above the other": 50.0}}
    some = {"force": torch.tensor([[0.0, 30.0]] * 3), "on": 20.0, "off": 10.0}
    built = lambda **more: {"model": model(), **NAMES, **more}  # noqa: E731
    for each in (LeggedNoises, LeggedErrors):
        yield Subject(each, wrong={one.name: d.NOT_NEGATIVE for one in fields(each)})
    yield Subject(LegKinematics, built, lambda legs: legs(torch.zeros(JOINTS)), {**ROBOT, "joints": JOINT_NAMES})
    yield Subject(LeggedEnv, partial(built, errors=LeggedErrors()), _rolled, env)
    yield Subject(contacts, lambda: dict(some), wrong={"force": forces, **threshold, "before": before})
    for kind in ("EKF", "DEnKF"):
        yield Subject(
            legged_filter,
            partial(built, dt=0.01, kind=kind, ensemble_size=8),
            _filtered,
            {**whole, "ensemble_size": d.LARGE_COUNT if kind == "DEnKF" else None},
            name=f"legged_filter, {kind}",
        )
    yield Subject(LearnedContacts, partial(built, rows=2, num_cells=(4,)), _of_last, learned)
    yield Subject(last_rows, lambda: {"rows": 3}, _kept, kept)
    yield Subject(with_last_rows, lambda: {"log": log(), "rows": 3}, wrong=kept)


def _robots() -> Iterator[Subject]:
    """Simulated ones of dm_control, which take seconds to make."""
    made = {"friction": d.POSITIVE, "softness": d.POSITIVE, "pushes": d.NOT_NEGATIVE, "errors": OTHERS, "seed": SEED}
    settings = {"rows": d.COUNT, "kind": d.CHOICE, "slip": d.NOT_NEGATIVE}
    yield Subject(quadruped.quadruped_env, use=_rolled, wrong=made)
    yield Subject(humanoid.humanoid_env, use=_rolled, wrong={**made, "speed": d.FINITE, "turn": d.FINITE})
    yield Subject(quadruped.quadruped, wrong=settings)
    for steps in (quadruped.trot, humanoid.stroll):
        numbers = dict.fromkeys(("time", "pace", "stride", "height", "lift"), d.FINITE)
        wrong = {name: numbers[name] for name in inspect.signature(steps).parameters if name in numbers}
        yield Subject(steps, lambda: {"time": 0.1}, wrong=wrong)


# ------------------------------------------------------------------------------------------------------------ entries

Change = Callable[[TensorDict], Any]


def _put(key: Any, change: Callable[[Tensor], Tensor | None]) -> Change:
    def act(rows: TensorDict) -> TensorDict:
        changed = change(rows[key])
        return rows.exclude(key) if changed is None else rows.set(key, changed)

    return act


def _at(number: float, place: int = 0, row: int = 2) -> Callable[[Tensor], Tensor]:
    def change(value: Tensor) -> Tensor:
        out = value.clone()
        out.view(-1, value.shape[-1])[row, place % value.shape[-1]] = number
        return out

    return change


WIDTHS = {
    "missing": lambda value: None,
    "too wide": lambda value: torch.cat([value, value[..., :1]], -1),
    "too narrow": lambda value: value[..., :-1],
    "without its last dimension": lambda value: value[..., 0],
}
NUMBERS = d.Wrong(
    {**WIDTHS, "nan": _at(NAN), "inf": _at(INF), "first row nan": _at(NAN, 0, 0)},
    st.tuples(st.sampled_from([NAN, INF, -INF]), st.integers(0, 3), st.integers(0, T - 1)).map(
        lambda one: (f"{one[0]} in component {one[1]} at {one[2]}", _at(*one))
    ),
)
OTHER_TYPES = d.Wrong({"float64": Tensor.double})
MASKS = d.Wrong({**WIDTHS, "float": Tensor.float, "int64": Tensor.long, "nan": lambda value: value.float() * NAN})
TIMES = d.Wrong({**WIDTHS, "nan": _at(NAN), "inf": _at(INF), "zero": _at(0.0), "negative": _at(-0.01)})
VALUES = {"imu": NUMBERS, "joints": NUMBERS, "joint_rates": NUMBERS, "contact": MASKS, "dt": TIMES.but("too narrow")}


def _made(kind: str) -> Any:
    return legged_filter(model(), **NAMES, dt="dt", kind=kind, ensemble_size=8)  # type: ignore[arg-type]


def _run(kind: str, change: Change) -> TensorDict:
    torch.manual_seed(0)
    return _filtered(_made(kind), change(log().clone()))


def _right(kind: str, near: float = 1e-4) -> Callable[[Any], bool]:
    def right(result: Any) -> bool:
        return d.finite(result) and d.same(result, _run(kind, lambda rows: rows), rtol=near, atol=near)

    return right


def _loss(change: Change) -> Tensor:
    torch.manual_seed(0)
    learned = LearnedContacts(model(), **NAMES, rows=2, num_cells=(4,))
    loss = learned.loss(change(with_last_rows(log(), 2)))
    loss.backward()
    return loss


def _learned_right(loss: Any) -> bool:
    return bool(loss == _loss(lambda rows: rows))


def _acted(change: Change) -> TensorDict:
    env = LeggedEnv(model(), **NAMES)
    return env.step(change(env.reset().set("action", torch.zeros(1))))["next"]


def _entries() -> Iterator[Target]:
    for kind in ("EKF", "UKF", "DEnKF"):
        act = lambda change, folder, kind=kind: _run(kind, change)  # noqa: E731
        for key, wrong in VALUES.items():
            rights = {"float": _right(kind), "int64": _right(kind)}
            changes = wrong.each(partial(_put, key))
            yield Target(BORDER, f"{kind} reads {key}", (key, "legs"), act, changes, None, rights)
            if key != "contact":
                changes = OTHER_TYPES.each(partial(_put, key))
                yield Target(BORDER, f"{kind} reads {key} in another type", (key,), act, changes, _right(kind))
    learns: dict[Any, d.Wrong] = {("true", "velocity"): NUMBERS, **{("last", key): VALUES[key] for key in KEYS}}
    for key, wrong in learns.items():
        act = lambda change, folder: _loss(change)  # noqa: E731
        rights = dict.fromkeys(("float", "int64"), _learned_right)
        changes = wrong.each(partial(_put, key))
        yield Target(BORDER, f"LearnedContacts learns from {'/'.join(key)}", (key[-1],), act, changes, None, rights)
    actions = d.Wrong({**WIDTHS, "nan": lambda value: value * NAN, "inf": lambda value: value + INF})
    act = lambda change, folder: _acted(change)  # noqa: E731
    changes = actions.but("without its last dimension").each(partial(_put, "action"))
    yield Target(BORDER, "LeggedEnv takes an action", ("action",), act, changes)


def targets() -> list[Target]:
    """All of them."""
    slow = targets_of(BORDER, *_robots(), needs=quadruped.quadruped_env, slow=True)
    return [*targets_of(BORDER, *_subjects()), *slow, *_entries()]
