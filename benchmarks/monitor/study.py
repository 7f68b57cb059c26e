"""The study: its options, its jobs, its tables."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from benchmarks.common.arguments import made_by, parse
from benchmarks.common.jobs import compute
from benchmarks.common.tables import head, line, report, write_page
from benchmarks.monitor import car
from benchmarks.monitor.drives import FAULTS, failing
from torch_denkf.applications.car import write_drives
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.kitti.render import render_drives

TASKS = ("ur5", "kitti-real", "kitti-rendered")


INVENTED = {"calibration": 16, "validation": 8}  # drives along random roads
SETTINGS = ("rate", "margin", "reference", "gate_margin")


@dataclass(frozen=True)
class Study:
    """Measures detection of unannounced faults on the UR5 and on KITTI, with the package's weights."""

    root: Path | None = None  # KITTI's folder with sequences and poses; without it there is no task kitti-real
    out: Path = Path("runs/monitor")  # also for demos, rendered drives and readings
    tasks: tuple[Literal["ur5", "kitti-real", "kitti-rendered"], ...] = TASKS
    rendered: tuple[str, ...] = ("00", "03", "04", "05", "07")  # drives along official trajectories, with faults
    frames: int = 600  # of a rendered drive
    draws: int = 3  # of the filter's noise
    choose: bool = False  # choose margins, rates and references on separate drives and demos, without tests
    processes: int = 1
    smoke: bool = False  # a tiny run on synthetic drives: does it run?


def invented(study: Study, kind: str) -> tuple[Path, list[str]]:
    """Returns the folder of rendered drives along random roads, and their names."""
    names = [f"{kind[0]}{number:02d}" for number in range(2 if study.smoke else INVENTED[kind])]
    frames = 80 if study.smoke else 500
    render_drives(study.out / kind, names=names, frames=frames, seed=77, size=(100, 300), processes=1)
    return study.out / kind, names


def rows_of(study: Study, task: str) -> list[dict]:
    """Returns the rows of one task."""
    cache = study.out / "readings"
    if task == "ur5":
        from benchmarks.monitor.arm import arm_rows, own_demos  # needs mujoco
        from torch_denkf.applications.ur5.train import whole_demos

        own = own_demos(study.out, 3) if study.smoke else own_demos(study.out)
        folder = whole_demos(study.out, 10 if study.smoke else 60, progress=False)
        return arm_rows(folder, own, study.out / "cache", study.draws)
    root, names = invented(study, "calibration")
    known = [failing(root, name, "clean", cache / "calibration") for name in names]
    if task == "kitti-real":
        assert study.root is not None
        drives = list_kitti_drives(study.root)
        return car.drive_rows(task, study.root, drives, known, cache / "real", study.draws)
    folder, poses = study.out / "rendered", None if study.root is None else study.root / "poses"
    options = {"size": (100, 300), "processes": 1}
    render_drives(folder, poses=poses, names=list(study.rendered), frames=study.frames, **options)
    return car.drive_rows(task, folder, study.rendered, known, cache / "rendered", study.draws)


def trials_of(study: Study, task: str) -> list[dict]:
    """Returns the trials of one task on drives or demos that are in no test; the last row has the choice."""
    if task == "ur5":
        from benchmarks.monitor.arm import chosen_on, own_demos
        from benchmarks.monitor.choice import choose_arm

        own = own_demos(study.out, 3) if study.smoke else own_demos(study.out)
        guard, rows = choose_arm(chosen_on(own, study.out / "cache"))
        return [*rows, {"trial": "arm: chosen", **asdict(guard)}]
    from benchmarks.monitor.choice import choose_car

    readings = study.out / "readings"
    root, names = invented(study, "calibration")
    known = [failing(root, name, "clean", readings / "calibration") for name in names]
    root, names = invented(study, "validation")
    seen = {fault: [failing(root, name, fault, readings / "validation") for name in names] for fault in FAULTS}
    seen["clean"] = [failing(root, name, "clean", readings / "validation") for name in names]
    seen["box-all, repaired"] = [failing(root, name, "box-all", readings / "validation", repair=True) for name in names]
    guard, rows = choose_car(known, seen, study.draws)
    return [*rows, {"trial": "car: chosen", **asdict(guard)}]


def choice_page(rows: Sequence[dict], study: Study) -> str:
    """Returns the page of all trials and the chosen settings."""
    lines = ["# Chosen settings", ""]
    lines += head("trial", "setting", "score")
    for row in rows:
        said = ", ".join(f"{key} {row[key]:g}" for key in SETTINGS if key in row)
        found = ", ".join(f"{key} {value:.4g}" for key, value in row.items() if key not in ("trial", *SETTINGS))
        lines.append(line(row["trial"], said, found))
    lines += [
        "",
        "Drives and demos of these trials are in no test. Car: 16 invented drives calibrate, each left out where it is",
        "judged itself; 8 others have the faults. Arm: 23 of 70 demos calibrate, 47 have the faults.",
        "",
        *made_by("monitor", f"; {study.draws} draws of the filter's noise"),
    ]
    return "\n".join(lines) + "\n"


def page(rows: Sequence[dict], study: Study) -> str:
    """Returns two tables: alarms, and errors."""
    lines = ["# Unannounced faults", ""]
    lines += head("task", "fault", "AUROC", "delay, steps", "found", "false alarms in 1,000 steps", "error afterwards")
    for row in rows:
        if "auroc" in row:
            cells = [f"{row[key]:.3g}" for key in ("auroc", "delay_steps", "found", "false_alarms_per_1000")]
            lines.append(line(row["task"], row["fault"], *cells, f"{row['error_ratio']:.3f}"))
    lines += [
        "",
        "AUROC: of the monitor's evidence, by steps. Delay: the median over the faults. Error afterwards: with the",
        "gate, 10 to 30 steps after the fault, as a multiple of the same steps' error in a run without the fault.",
        "",
    ]
    lines += head("UR5", "error", "with the gate")
    for row in rows:
        if "error" in row:
            lines.append(line(row["fault"], f"{row['error']:.2f}", f"{row['error_gated']:.2f}"))
    lines += ["", "Mean error in units of 0.02 rad and 2.5 mm, while the fault lasts (none: of all steps).", ""]
    lines += head("drives", "fault", "m/m", "holds v, theta_dot", "with the gate, m/m", "holds v, theta_dot")
    for row in rows:
        if "m_per_m" in row:
            cells = []
            for suffix in ("", "_gated"):
                held = [100 * row[name + suffix] for name in ("held_v", "held_theta_dot")]
                cells += [f"{row['m_per_m' + suffix]:.4f}", "{:.0f}, {:.0f} %".format(*held)]
            lines.append(line(row["task"], row["fault"], *cells))
    lines += [
        "",
        "End point error over 100 steps, and the truth's share in 90 % intervals. black-all: 30 % of the frames;",
        "with the gate, what the pictures speak against is read again over two or three steps. box-all: a box hides",
        "5 % of each frame; with the gate, the flow is continued over it.",
        "",
        *made_by("monitor", f"; {study.draws} draws of the filter's noise"),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Runs the study; an interrupted one resumes."""
    study = parse(Study)
    if study.smoke:
        out = Path(tempfile.mkdtemp(prefix="monitor-"))
        write_drives(out / "kitti", ["a", "b"], frames=70, size=(100, 300))
        drives, tasks = ("a",), TASKS if study.tasks == TASKS else study.tasks
        study = replace(study, root=out / "kitti", out=out, rendered=drives, frames=70, draws=1, tasks=tasks)
    if study.choose:
        tasks = ["ur5"] * ("ur5" in study.tasks) + ["car"] * any(task != "ur5" for task in study.tasks)
    else:
        tasks = [task for task in study.tasks if task != "kitti-real" or study.root is not None]
    folder, rows_for = (study.out / "choice", trials_of) if study.choose else (study.out / "parts", rows_of)
    rows = compute(
        {folder / f"{task}.json": partial(rows_for, study, task) for task in tasks}, study.processes, "monitor"
    )
    if study.choose:
        write_page(choice_page(rows, study), study.out / "choice.md")
        return
    rows = sorted(rows, key=lambda row: (TASKS.index(row["task"]), row["fault"]))
    report(study.out, rows, page(rows, study), "monitor")
