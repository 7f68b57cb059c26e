"""The study: its options, its rows, its table."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Literal

import pandas as pd
import torch
from tensordict import TensorDict

from benchmarks.common.arguments import command, made_by, parse
from benchmarks.common.tables import markdown, pick, records, write_page, write_table
from benchmarks.legged.pictures import draw
from benchmarks.legged.task import FIRM, GROUNDS, LEVEL, SIMULATED, Robot, icub, jittered, scores, simulated
from benchmarks.legged.training import CELLS, VELOCITY, learned_contacts, trained_lstm
from torch_denkf.applications.legged import LearnedContacts, LeggedNoises, legged_filter
from torch_denkf.applications.legged.quadruped import quadruped
from torch_denkf.pretrained import from_pretrained, save_pretrained

#: Noises of the feet, from joint angles in m and from joint rates in m/s: validation chooses one pair.
KINEMATICS, RATES = (0.01, 0.03, 0.1), (0.3, 1.0)
#: Gyro in rad/s/sqrt(Hz), accelerometer in m/s^2/sqrt(Hz). The simulated ones are a little above their data sheets.
SENSOR = (1e-3, 5e-3)
#: The same for a log with uneven stamps, where each reading is integrated over a wrong time. Validation chooses one.
STAMPED = ((1e-3, 5e-3), (5e-3, 2e-2), (1e-2, 5e-2), (2e-2, 0.1), (4e-2, 0.2))
NOISES = ("kinematics", "rate", "gyro", "accelerometer")
ICUB = "iCub, real"
#: Names of the data of each simulated robot, with their grounds.
DATA = {kind: {f"{kind}, {name}": ground for name, ground in GROUNDS.items()} for kind in SIMULATED}
ORDER = [*DATA["quadruped"], *DATA["humanoid"], ICUB]
#: Columns of the page, with their digits.
SCORES = {
    "velocity": ("velocity, m/s", 3),
    "certain": ("velocity where the truth is sure, m/s", 3),
    "tilt": ("tilt, deg", 2),
    "drift": ("drift, %", 1),
    "nees": ("NEES", 2),
    "held": ("coverage", 2),
    "ms": ("ms per step", 0),
}
HEADS = ("joints' angles, m", "joints' rates, m/s", "gyro, rad/s/sqrt(Hz)", "accelerometer, m/s^2/sqrt(Hz)")
SHOWN = list(DATA["quadruped"])[1]  # in the plot
VALIDATION_RUNS = 8
RESULTS = Path(__file__).parent / "results"
KINDS = {
    "EKF": {"kind": "EKF"},
    "UKF": {"kind": "UKF"},
    "DEnKF, 32 members": {"kind": "DEnKF", "ensemble_size": 32},
    "DEnKF, 32 members, significance": {"kind": "DEnKF", "ensemble_size": 32, "threshold": 2.0},  # of 1, 1.5, 2 and 3
    "DEnKF, 48 members": {"kind": "DEnKF", "ensemble_size": 48},
    "DEnKF, 64 members": {"kind": "DEnKF", "ensemble_size": 64},
}


Part = Literal["quadruped", "humanoid", "icub"]


@dataclass(frozen=True)
class Study:
    """Estimates the velocity of a walking robot's base from its inertial sensor, joints and feet."""

    out: Path = Path("runs/legged")  # folder for legged.csv, legged.md and legged.png
    icub: Path = Path("../shared/data/icub")  # with walking.npz and model.urdf; skipped if they are missing
    parts: tuple[Part, ...] = ("quadruped", "humanoid", "icub")  # rows of the others are read from legged.csv
    kinds: tuple[str, ...] = ()  # run only these filters, with the library's contacts of the quadruped
    runs: int = 20  # of the test, on each ground
    seconds: float = 20.0  # of such a run
    training_runs: int = 120  # of 6 s each
    updates: int = 3000  # of the learned contacts
    lstm_updates: int = 500
    seed: int = 0
    smoke: bool = False  # a few short runs: does it run?


@torch.no_grad()
def run(robot: Robot, **options) -> tuple[TensorDict, float]:
    """Returns a filter's belief on a robot's log, and processor milliseconds per step of all runs.

    Args:
        robot: with its log.
        **options: of the filter; its precision is that of the log.
    """
    filter = legged_filter(robot.model, **robot.names, dt=robot.dt, **options).to(robot.log["imu"].dtype)
    torch.manual_seed(0)
    began = time.process_time()
    out = filter.sequence(robot.log.clone(), keep=[VELOCITY, ("belief", "velocity_var"), ("belief", "mean")])
    return out["belief"], 1e3 * (time.process_time() - began) / robot.log.shape[1]


def scored(robot: Robot, belief: TensorDict) -> dict[str, float]:
    """Returns scores of a belief."""
    return scores(robot, belief["velocity"], belief["velocity_var"], belief["mean"])


def in_the_air(robot: Robot) -> Robot:
    """Returns the log without contacts, so that a filter only integrates the inertial sensor."""
    log = robot.log.clone()
    log["contact"] = torch.zeros_like(log["contact"])
    return replace(robot, log=log)


def chosen(make: Callable[[], Robot], name: str, grid: Iterable[dict[str, float]], out: Path) -> LeggedNoises:
    """Returns the noises of a grid with the highest likelihood of the true velocity.

    Args:
        make: makes the log.
        name: of the log.
        grid: noises.
        out: folder with ``validation.csv``, whose rows are not run again.
    """
    file, robot = out / "validation.csv", None
    rows = records(file)
    for options in grid:
        if not pick(rows, data=name, **options):
            robot = make() if robot is None else robot
            found = scored(robot, run(robot, kind="EKF", noises=LeggedNoises(**options))[0])
            rows.append({"data": name, **options, **{key: found[key] for key in ("velocity", "nees", "held", "nll")}})
            print("validation", rows[-1], flush=True)
            write_table(rows, file, ("data", *NOISES))
    return best(rows, name)


def best(rows: list[dict], name: str) -> LeggedNoises:
    """Returns the noises with the highest likelihood of the true velocity, from the rows of a log."""
    row = min(pick(rows, data=name), key=lambda row: row["nll"])
    return LeggedNoises(**{key: row[key] for key in NOISES})


def feet_grid(smoke: bool) -> list[dict[str, float]]:
    """Returns candidate noises of the feet, with those of the simulated sensor."""
    pairs = list(product(KINEMATICS, RATES))[: 1 if smoke else None]
    gyro, accelerometer = SENSOR
    return [{"kinematics": k, "rate": r, "gyro": gyro, "accelerometer": accelerometer} for k, r in pairs]


def filter_rows(
    robots: dict[str, Robot], variants: dict[str, dict], kinds: dict[str, dict], integrated: bool = True
) -> tuple[list[dict], dict[str, TensorDict]]:
    """Returns rows of the library's filters, and their beliefs on all runs by filter.

    Args:
        robots: by the name of the data, with logs of one shape, which are filtered in one batch.
        variants: noises and contacts of every filter, by a suffix of its name. The noises of the first variant are also
            those of the integrated sensor.
        kinds: options of the filters, by name.
        integrated: whether the inertial sensor alone has a row.
    """
    every = replace(next(iter(robots.values())), log=torch.cat([robot.log for robot in robots.values()]))
    runs = {
        kind + label: run(every, **variant, **options)
        for kind, options in kinds.items()
        for label, variant in variants.items()
    }
    noises = next(iter(variants.values()))["noises"]
    used = {key: getattr(noises, key) for key in NOISES}
    if integrated:
        runs["integrated inertial sensor"] = run(in_the_air(every), noises=noises, kind="EKF")
    rows = []
    for name, (belief, ms) in runs.items():
        parts = belief.chunk(len(robots))
        for (data, robot), part in zip(robots.items(), parts, strict=True):
            draws = {"draws": "exact"} if name.startswith("DEnKF") else {}
            rows.append({"data": data, "filter": name, **draws, **scored(robot, part), "ms": ms, **used})
            print(rows[-1], flush=True)
    return rows, {name: belief for name, (belief, _) in runs.items()}


def still(robot: Robot) -> dict[str, float]:
    """Returns scores of a constant zero velocity."""
    zero = torch.zeros_like(robot.log["true", "velocity"])
    return {key: scores(robot, zero, torch.ones_like(zero))[key] for key in ("velocity", "certain")}


def page(frame: pd.DataFrame, study: Study) -> str:
    """Returns the table."""
    lines = [
        "# Velocity of a legged base",
        "",
        "Velocity is the root mean square error of the base's velocity, all three axes together, in the base's axes; "
        "tilt that of where up is. Drift is how far the end of the path is off, over the path's length. NEES is the "
        "squared error of the velocity in units of the variance, over its expectation: above 1 a filter is too sure. "
        f"Coverage is the share of true velocities within the {LEVEL:.0%} intervals.",
    ]
    frame = frame.reindex(columns=["data", "filter", "draws", *SCORES, *NOISES])
    shown = frame[["filter", "draws"]].assign(
        **{title: frame[key].map(f"{{:.{digits}f}}".format, "ignore") for key, (title, digits) in SCORES.items()}
    )
    for data, own in shown.groupby(frame["data"], sort=False):
        own = own if data == ICUB else own.drop(columns=SCORES["certain"][0])
        lines += ["", f"## {data}", "", *markdown(own.set_index("filter"))]
    with_noises = frame[frame["filter"].str.startswith("EKF")].set_index("filter")[list(NOISES)]
    robots = frame.loc[frame["filter"].str.startswith("EKF"), "data"].str.split(",").str[0]
    noises = with_noises.groupby(robots.to_numpy(), sort=False).last().rename_axis("noises").map("{:g}".format)
    lines += [
        "",
        f"Simulated: {study.runs} runs of {study.seconds:g} s on each ground, scored from 1 s on; every run has biases "
        f"of its own. Contacts and LSTM are trained on {study.training_runs} other runs of 6 s of that robot, whose "
        "friction is 0.15 to 1.5, whose floor gives way in 0.01 to 0.06 s, and whose pushes are up to 250 N, on the "
        "humanoid 100 N. Noises are chosen on further runs, by the likelihood of the true velocity: on the training's "
        "grounds for all simulated rows. iCub has those of the simulated humanoid on firm ground, whose rows were "
        "stamped as unevenly as iCub's. Milliseconds are those of the processor for a step of all "
        f"{study.runs * len(GROUNDS)} runs of a simulated robot, or of iCub's, without compilation, one thread. "
        "`--kinds` runs some filters again, with the quadruped's contacts that the library has.",
        "",
        *markdown(noises.set_axis(HEADS, axis=1)),
        "",
        *made_by("legged"),
        f"* Seed: {study.seed}.",
    ]
    return "\n".join(lines) + "\n"


def again(study: Study, kind: str) -> list[dict]:
    """Returns rows of some filters on all grounds, with the noises that were chosen before."""
    if kind == "icub":
        robots = {ICUB: icub(study.icub)}
        names = "humanoid, firm ground, uneven stamps"
    else:
        robots = grounds(study, kind)
        names = f"{kind}, all grounds"
    noises = best(records(RESULTS / "validation.csv"), names)
    variants = {"" if kind == "icub" else ", threshold": {"noises": noises}}
    if kind == "quadruped":
        trained = next(m for m in from_pretrained(kind).modules() if isinstance(m, LearnedContacts))
        variants[", learned"] = {"noises": noises, "contacts": trained}
    return filter_rows(robots, variants, {name: KINDS[name] for name in study.kinds}, integrated=False)[0]


def grounds(study: Study, kind: str) -> dict[str, Robot]:
    """Returns a simulated robot's test logs."""
    return {
        name: simulated(kind, study.runs, study.seconds, study.seed + 3 + number, ground)
        for number, (name, ground) in enumerate(DATA[kind].items())
    }


def walked(study: Study, kind: str) -> list[dict]:
    """Returns the rows of a simulated robot; for the quadruped it also saves the plot and the trained filter."""
    length = 0.3 if study.smoke else 6.0
    make = partial(simulated, kind, VALIDATION_RUNS, length, study.seed + 2)
    noises = chosen(make, f"{kind}, all grounds", feet_grid(study.smoke), study.out)
    training = simulated(kind, study.training_runs, length, study.seed + 1)
    validation = make()
    out = study.out / "trained" / kind
    contacts = learned_contacts(training, validation, noises, study.updates, out)
    lstm = trained_lstm(training, validation, contacts, study.lstm_updates, out)
    if kind == "quadruped":
        _save(contacts, noises, study)
    robots = grounds(study, kind)
    kinds = {"EKF": KINDS["EKF"]} if study.smoke else KINDS
    variants = {", threshold": {"noises": noises}, ", learned": {"noises": noises, "contacts": contacts}}
    rows, beliefs = filter_rows(robots, variants, kinds)
    for name, robot in robots.items():
        with torch.no_grad():
            found = scores(robot, *lstm(lstm.read(robot.log)))
        rows += [{"data": name, "filter": "LSTM", **found}, {"data": name, "filter": "standing still", **still(robot)}]
    if SHOWN in robots:
        number = list(robots).index(SHOWN)
        shown = {label: beliefs[f"EKF, {label}"].chunk(len(robots))[number] for label in ("threshold", "learned")}
        draw(robots[SHOWN], shown, study.out / "legged.png")
    return rows


def _save(contacts: LearnedContacts, noises: LeggedNoises, study: Study) -> None:
    """Saves the quadruped's filter with its trained contacts in the folder, for ``from_pretrained``."""
    settings: dict = {"num_cells": list(CELLS), **{key: getattr(noises, key) for key in NOISES}}
    filter = quadruped(**settings)
    trained = next(module for module in filter.modules() if isinstance(module, LearnedContacts))
    trained.load_state_dict(contacts.state_dict())
    training = {"command": command("legged"), "seed": study.seed, "runs": study.training_runs, "updates": study.updates}
    save_pretrained(filter, study.out / "quadruped", builder=quadruped, settings=settings, training=training)


def real(study: Study) -> list[dict]:
    """Returns the rows of iCub."""
    robot = icub(study.icub)
    make = partial(simulated, "humanoid", VALIDATION_RUNS, 6.0, study.seed + 2, FIRM)
    firm = chosen(make, "humanoid, firm ground", feet_grid(study.smoke), study.out)
    feet = {"kinematics": firm.kinematics, "rate": firm.rate}
    grid = [{**feet, "gyro": gyro, "accelerometer": accelerometer} for gyro, accelerometer in STAMPED]
    noises = chosen(lambda: jittered(make(), robot), "humanoid, firm ground, uneven stamps", grid, study.out)
    rows = filter_rows({ICUB: robot}, {"": {"noises": noises}}, KINDS)[0]
    return [*rows, {"data": ICUB, "filter": "standing still", **still(robot)}]


def main() -> None:
    """Runs the study."""
    study = parse(Study)
    if study.smoke:
        out = Path(tempfile.mkdtemp(prefix="legged-"))
        tiny = {"runs": 1, "seconds": 0.3, "training_runs": 4, "updates": 1, "lstm_updates": 1}
        study = replace(study, out=out, parts=("quadruped", "humanoid"), **tiny)
    torch.manual_seed(study.seed)
    parts: dict[str, Callable[[Study], list[dict]]] = {kind: partial(walked, kind=kind) for kind in SIMULATED}
    if (study.icub / "walking.npz").exists():
        parts["icub"] = real
    study.out.mkdir(parents=True, exist_ok=True)
    rows = records(study.out / "legged.csv")
    for part in [part for part in study.parts if part in parts]:
        began = time.monotonic()
        made = again(study, part) if study.kinds else parts[part](study)
        # A full run replaces all rows of its data, a run of some filters only those of these filters.
        replaced = {(row["data"], row["filter"] if study.kinds else None) for row in made}
        rows = [row for row in rows if (row["data"], row["filter"] if study.kinds else None) not in replaced]
        rows += made
        print(f"{part}: {(time.monotonic() - began) / 60:.0f} min", flush=True)
        rows.sort(key=lambda row: (ORDER.index(row["data"]), row["filter"]))
        table = write_table(rows, study.out / "legged.csv", ())
    write_page(page(table, study), study.out / "legged.md")
