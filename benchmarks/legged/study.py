"""The study: its options, its rows, its table."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.tables import Columns, head, line, write_page
from benchmarks.legged.pictures import draw
from benchmarks.legged.task import GROUNDS, LEVEL, Robot, humanoid, quadruped, scores
from benchmarks.legged.training import VELOCITY, learned_contacts, trained_lstm
from torch_denkf.applications.legged import LearnedContacts, LeggedNoises, legged_filter

#: Of the feet, by the joints' angles in m and by their rates in m/s: one pair is chosen in validation.
KINEMATICS, RATES = (0.01, 0.02, 0.03), (0.3, 1.0, 3.0)
SCORES = ("velocity", "certain", "tilt", "drift", "nees", "held", "ms")
COLUMNS = Columns(
    names=("data", "filter", *SCORES),
    text=("data", "filter"),
    whole=(),
    order=lambda row: (row["data"], row["filter"]),
)
KINDS = {
    "EKF": {"kind": "EKF"},
    "UKF": {"kind": "UKF"},
    "DEnKF, 32 members": {"kind": "DEnKF", "ensemble_size": 32},
    "DEnKF, 64 members": {"kind": "DEnKF", "ensemble_size": 64},
}


@dataclass(frozen=True)
class Study:
    """How fast is a walking robot's base, by its inertial sensor, joints and feet?"""

    out: Path | None = None  # folder for legged.csv, legged.md and legged.png
    icub: Path = Path("../shared/data/icub")  # with walking.npz and model.urdf; left out where they are missing
    runs: int = 6  # of the test, on each ground
    seconds: float = 10.0  # of such a run
    training_runs: int = 32  # of 6 s each; a quarter as many are for validation
    updates: int = 120  # of the learned contacts
    lstm_updates: int = 1000
    seed: int = 0
    smoke: bool = False  # a few short runs: does it run?


@torch.no_grad()
def run(robot: Robot, **options) -> tuple[dict[str, float], TensorDict]:
    """Scores of a filter on a robot's log, with milliseconds of the processor for a step of all runs; and its belief.

    Args:
        robot: with its log.
        **options: of the filter; its precision is that of the log.
    """
    filter = legged_filter(robot.model, **robot.names, dt=robot.dt, **options).to(robot.log["imu"].dtype)
    torch.manual_seed(0)
    began = time.process_time()
    belief = filter.sequence(robot.log.clone(), keep=[VELOCITY, ("belief", "velocity_var"), ("belief", "mean")])
    ms = 1e3 * (time.process_time() - began) / robot.log.shape[1]
    belief = belief["belief"]
    return {**scores(robot, belief["velocity"], belief["velocity_var"], belief["mean"]), "ms": ms}, belief


def in_the_air(robot: Robot) -> Robot:
    """The same log, in which no foot ever stands: what is left is to integrate the inertial sensor."""
    log = robot.log.clone()
    log["contact"] = torch.zeros_like(log["contact"])
    return replace(robot, log=log)


def chosen(validation: Robot, smoke: bool) -> LeggedNoises:
    """The noises of the feet under which the true velocity is likeliest."""
    found = {}
    for kinematics, rate in product(KINEMATICS[-1:], RATES[:1]) if smoke else product(KINEMATICS, RATES):
        noises = LeggedNoises(kinematics=kinematics, rate=rate)
        found[noises] = run(validation, kind="EKF", noises=noises)[0]
        numbers = {key: round(found[noises][key], 3) for key in ("nll", "velocity", "nees", "held")}
        print(f"validation, kinematics {kinematics}, rate {rate}: {numbers}", flush=True)
    return min(found, key=lambda noises: found[noises]["nll"])


def filter_rows(
    robot: Robot, name: str, noises: LeggedNoises, contacts: LearnedContacts | None, kinds: dict[str, dict]
) -> Iterator[tuple[dict, TensorDict]]:
    """Rows of the library's filters, and their beliefs.

    Args:
        robot: with its log.
        name: of the data.
        noises: of the filters.
        contacts: that are learned, for further rows; ``None`` for none.
        kinds: options of the filters, by name.
    """
    for kind, options in kinds.items():
        variants = {"": None} if contacts is None else {", threshold": None, ", learned": contacts}
        for label, used in variants.items():
            found, belief = run(robot, noises=noises, contacts=used, **options)
            yield {"data": name, "filter": f"{kind}{label}", **found}, belief
    found, belief = run(in_the_air(robot), noises=noises, kind="EKF")
    yield {"data": name, "filter": "integrated inertial sensor", **found}, belief


def still(robot: Robot) -> dict[str, float]:
    """Scores of a velocity of zero: how fast the robot is."""
    zero = torch.zeros_like(robot.log["true", "velocity"])
    return {key: scores(robot, zero, torch.ones_like(zero))[key] for key in ("velocity", "certain")}


def page(rows: list[dict], study: Study, noises: LeggedNoises) -> str:
    """The table."""
    lines = [
        "# How fast is the base",
        "",
        "Velocity is the root mean square error of the base's velocity, all three axes together, in the base's axes; "
        "tilt that of where up is. Drift is how far the end of the path is off, over the path's length. NEES is the "
        "squared error of the velocity in units of the variance, over its expectation: above 1 a filter is too sure. "
        f"Held is the share of true velocities within the {LEVEL:.0%} intervals.",
    ]
    titles = ("filter", "velocity, m/s", "tilt, deg", "drift, %", "NEES", "held", "ms a step")
    digits = {"velocity": 3, "tilt": 2, "drift": 1, "nees": 2, "held": 2, "ms": 0}
    for data in dict.fromkeys(row["data"] for row in rows):
        real = data.startswith("iCub")
        own = {"velocity": 3, "certain": 3, **digits} if real else digits
        lines += ["", f"## {data}", ""]
        lines += head(*titles[:2], *(["velocity where the truth is sure, m/s"] if real else []), *titles[2:])
        for row in rows:
            if row["data"] == data:
                lines.append(line(row["filter"], *(f"{row[k]:.{d}f}" if k in row else "" for k, d in own.items())))
    lines += [
        "",
        f"Simulated: {study.runs} runs of {study.seconds:g} s on each ground, scored from 1 s on; every run has biases "
        "of its own. The noises of the feet were chosen, and contacts and LSTM trained, on other simulated runs: "
        f"kinematics {noises.kinematics:g} m, rate {noises.rate:g} m/s. iCub has these noises, too. Milliseconds are "
        "those of the processor for a step of all runs of a table at once, without compilation, one thread.",
        "",
        *made_by("legged"),
        f"* Seed: {study.seed}.",
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    if study.smoke:
        study = replace(study, runs=1, seconds=0.3, training_runs=4, updates=1, lstm_updates=1)
    began = time.monotonic()
    torch.manual_seed(study.seed)
    length = 0.3 if study.smoke else 6.0
    training = quadruped(study.training_runs, length, study.seed + 1)
    validation = quadruped(study.training_runs // 4, length, study.seed + 2)
    noises = chosen(validation, study.smoke)
    window = min(50, training.log.shape[1] - 1)
    contacts = learned_contacts(training, noises, study.updates, window)
    lstm = trained_lstm(training, validation, contacts, study.lstm_updates)
    rows: list[dict] = []
    beliefs: dict[str, TensorDict] = {}
    kinds = {"EKF": KINDS["EKF"]} if study.smoke else KINDS
    for number, (name, ground) in enumerate(GROUNDS.items()):
        robot = quadruped(study.runs, study.seconds, study.seed + 3 + number, ground)
        found = list(filter_rows(robot, name, noises, contacts, kinds))
        if name == "slippery":
            slides, beliefs = robot, {row["filter"]: belief for row, belief in found}
        with torch.no_grad():
            found.append(({"data": name, "filter": "LSTM", **scores(robot, *lstm(lstm.read(robot.log)))}, None))
        rows += [row for row, _ in found] + [{"data": name, "filter": "standing still", **still(robot)}]
        _say(rows, name)
    if (study.icub / "walking.npz").exists() and not study.smoke:
        robot, name = humanoid(study.icub), "iCub, real"
        rows += [row for row, _ in filter_rows(robot, name, noises, None, kinds)]
        rows.append({"data": name, "filter": "standing still", **still(robot)})
        _say(rows, name)
    print(f"{(time.monotonic() - began) / 60:.0f} min", flush=True)
    if study.out is not None:
        study.out.mkdir(parents=True, exist_ok=True)
        COLUMNS.write(rows, study.out / "legged.csv")
        draw(slides, {label: beliefs[f"EKF, {label}"] for label in ("threshold", "learned")}, study.out / "legged.png")
    write_page(page(rows, study, noises), None if study.out is None else study.out / "legged.md")


def _say(rows: list[dict], name: str) -> None:
    for row in rows:
        if row["data"] == name:
            print(name, row["filter"], {key: f"{row[key]:.3g}" for key in SCORES if key in row}, flush=True)
