"""Legged robots: their models, noises and errors, and what makes a robot, its log and what reads it."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
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
from benchmarks.reliability.damage import INF, NAN, put, spoiled
from benchmarks.reliability.target import Source, Subject, Target, targets_of
from tests.borders.readings import MASKS
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

T, JOINTS, FEET = 5, 4, ["left", "right"]
NAMES: dict[str, Any] = {"feet": FEET, "imu": "imu"}
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
    """Returns a robot of two legs, each with a hinge and a slide."""
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


def lasting_log() -> TensorDict:
    """Returns the log with the last rows of each row."""
    return with_last_rows(log(), 2)


def run(kind: str, rows: TensorDict) -> TensorDict:
    """Filters a log whose steps may differ in length."""
    torch.manual_seed(0)
    made = legged_filter(model(), **NAMES, dt="dt", kind=kind, ensemble_size=8)  # type: ignore[arg-type]
    return filtered(made, rows)


def filtered(filter: Any, rows: TensorDict | None = None) -> TensorDict:
    """Returns beliefs of a log, behind a rejection that raises."""
    torch.manual_seed(0)
    readings = dict.fromkeys(("imu", "joints", "joint_rates"), "contact")
    with torch.no_grad():
        rows = RejectReadings(readings, on_bad="raise")((log() if rows is None else rows).clone())
        return filter.sequence(rows).select(*filter.belief_keys)


def learned_loss(rows: TensorDict) -> Tensor:
    """Returns a loss of a network of contacts, whose gradients are taken."""
    torch.manual_seed(0)
    loss = LearnedContacts(model(), **NAMES, rows=2, num_cells=(4,)).loss(rows)
    loss.backward()
    return loss.detach()


def standing() -> TensorDict:
    """Returns the robot at its start, with an action."""
    return LeggedEnv(model(), **NAMES).reset().set("action", torch.zeros(1))


def acted(row: TensorDict) -> TensorDict:
    """Returns the robot after that action."""
    env = LeggedEnv(model(), **NAMES)
    env.reset()
    return env.step(row)["next"]


# ---------------------------------------------------------------------------------------------------------- entries

_LOG = d.broken(0, 2, places=st.tuples(st.just(0), st.integers(0, T - 1), st.integers(0, 2)))
_LOG = d.SHAPES.but("a dimension more") | _LOG | {"first row nan": spoiled((0, 0, 0), NAN)}
_FLAGS = d.SHAPES.but("a dimension more") | MASKS.but("without its last dimension")
_FLAGS |= {"nan": lambda mask: mask.float() * NAN}
_TIMES = d.SHAPES.but("a dimension more", "too narrow")
_TIMES |= d.of(NAN, INF, 0.0, -0.01).each(lambda value: spoiled((0, 2, 0), value))
READ = {**dict.fromkeys(("imu", "joints", "joint_rates"), _LOG), "contact": _FLAGS, "dt": _TIMES}


def _entries() -> Iterator[Target]:
    """Returns readings of filters of legged robots, rows that networks learn from, and arguments of environments."""
    for kind in ("EKF", "UKF", "DEnKF"):
        source = Source("legged robots", log, partial(run, kind), f"{kind} reads ")
        right = source.like(near=1e-4)
        for key, wrong in READ.items():
            rights = {"float": right, "int64": right}
            yield source.target(key, wrong.each(partial(put, key)), None, (key, "legs"), rights=rights)
            if key != "contact":
                yield source.target(f"{key} in another type", put(key, Tensor.double), right, key)
    source = Source("legged robots", lasting_log, learned_loss, "LearnedContacts learns from ")
    learns: dict[Any, d.Wrong] = {("last", key): wrong for key, wrong in READ.items() if key != "dt"}
    for key, wrong in {("true", "velocity"): _LOG, **learns}.items():
        rights = {"float": source.like(), "int64": source.like()}
        yield source.target("/".join(key), wrong.each(partial(put, key)), None, key[-1], rights=rights)
    wrong = d.SHAPES.but("a dimension more", "without its last dimension").each(partial(put, "action"))
    wrong |= {f"{value}": put("action", lambda action, value=value: action + value) for value in (NAN, INF)}
    act = Source("legged robots", standing, acted, "LeggedEnv takes ")
    yield act.target("an action", wrong, None, "action")


# -------------------------------------------------------------------------------------------------------- arguments

OTHERS = d.of(0.1, "none", {"gyro": 0.1})
JOINT_NAMES = ["left_hip", "left_knee", "right_hip"]
ROBOT: dict[str, d.Wrong | None] = {
    "model": d.of(None, "robot.xml", torch.nn.Linear(1, 1)),
    "feet": d.of(["left", "tail"], "left", [1, 2], [], ["left"] * 2),
    "imu": d.of("tail", 3, None, ""),
    "joints": d.of(
        [*JOINT_NAMES, "tail"], JOINT_NAMES[:2], [*JOINT_NAMES, "right_knee", "left_hip"], "left_hip", [0, 1, 2, 3]
    ),
}
SWITCH = {"on": d.FINITE | {"below the other": 5.0}, "off": d.FINITE | {"above the other": 50.0}}
MADE = {"pushes": d.NOT_NEGATIVE, "seed": d.of("x", 0.5, -1), "errors": OTHERS | {"noises": LeggedNoises()}}


def _of_last(made: LearnedContacts) -> Tensor:
    return made(with_last_rows(log(), made.rows))["legs", "moves"]


def _subjects() -> Iterator[Subject]:
    kept = dict.fromkeys(("rows", "every"), d.COUNT)
    whole = {
        **ROBOT,
        "kind": d.CHOICE,
        "threshold": d.POSITIVE,
        "noises": OTHERS | {"errors": LeggedErrors()},
        "contacts": OTHERS | {"a module": torch.nn.Linear(1, 1)},
        "gravity": d.FINITE | {"nothing": None},
    }
    env = {**ROBOT, **MADE, **SWITCH, "dt": d.POSITIVE | {"no multiple": 0.0033}, "joints": None}
    learned = {**ROBOT, "rows": d.COUNT, "rate": d.POSITIVE, "lasts": d.POSITIVE | {"less": 0.5}}
    forces = d.of("much", 3.0, torch.ones(2), torch.full((3, 2), NAN))
    before = d.of(torch.ones(2), torch.ones(3, dtype=torch.bool), "all")
    some = {"force": torch.tensor([[0.0, 30.0]] * 3), "on": 20.0, "off": 10.0}
    built = partial(dict, model=model(), **NAMES)
    for each in (LeggedNoises, LeggedErrors):
        yield Subject(each, wrong={one.name: d.NOT_NEGATIVE for one in fields(each)})
    yield Subject(LegKinematics, built, lambda legs: legs(torch.zeros(JOINTS)), ROBOT)
    yield Subject(LeggedEnv, partial(built, errors=LeggedErrors()), lambda env: env.rollout(3), env)
    yield Subject(contacts, lambda: dict(some), wrong={"force": forces, **SWITCH, "before": before})
    for kind, members in (("EKF", None), ("DEnKF", d.LARGE_COUNT)):
        sound, wrong = partial(built, dt=0.01, kind=kind, ensemble_size=8), {**whole, "ensemble_size": members}
        yield Subject(legged_filter, sound, filtered, wrong, name=f"legged_filter, {kind}")
    yield Subject(LearnedContacts, partial(built, rows=2, num_cells=(4,)), _of_last, learned)
    inside = lambda made: TransformedEnv(LeggedEnv(**built()), made).rollout(2)  # noqa: E731
    yield Subject(last_rows, lambda: {"rows": 3}, inside, kept)
    yield Subject(with_last_rows, lambda: {"log": log(), "rows": 3}, wrong=kept)


def _robots() -> Iterator[Subject]:
    """Simulated ones of dm_control, which take seconds to make."""
    made = {**MADE, "friction": d.POSITIVE, "softness": d.POSITIVE, "speed": d.FINITE, "turn": d.FINITE}
    yield Subject(quadruped.quadruped, wrong={"rows": d.COUNT, "kind": d.CHOICE, "slip": d.NOT_NEGATIVE})
    steps = dict.fromkeys(("time", "pace", "stride", "height", "lift"), d.FINITE)
    for make, wrong, sound in (
        (quadruped.quadruped_env, made, {}),
        (humanoid.humanoid_env, made, {}),
        (quadruped.trot, steps, {"time": 0.1}),
        (humanoid.stroll, steps, {"time": 0.1}),
    ):
        taken = {name: wrong[name] for name in inspect.signature(make).parameters if name in wrong}
        use = (lambda env: env.rollout(3)) if wrong is made else (lambda result: result)
        yield Subject(make, partial(dict, sound), use, taken)


def targets() -> Iterator[Target]:
    """Yields all entries and arguments."""
    yield from _entries()
    yield from targets_of("legged robots", *_subjects())
    yield from targets_of("legged robots", *_robots(), needs=quadruped.quadruped_env, slow=True)
