"""A car's path with an occluding box for ten seconds: ``python -m benchmarks.odometry.hidden --root KITTI``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import head, line
from torch_denkf import from_pretrained
from torch_denkf.applications.car import read_kitti_drive
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.odometry.failing_drive import drive_scores, track_failing_drive
from torch_denkf.applications.car.odometry.failures import CameraFailure
from torch_denkf.metrics import interval_coverage

FIRST, STEPS = 60, 97  # ten seconds
RUNS = {"no box": (False, True), "a box, not looked for": (True, False), "a box, looked for": (True, True)}


@dataclass(frozen=True)
class Hidden:
    """Runs the shipped filter on drives with an occluding box, with and without detection of static regions."""

    root: Path  # folder with sequences and poses
    checkpoint: str = "car-odometry"  # a pretrained filter, or a folder of denkf train


def main() -> None:
    """Prints the table."""
    study = parse(Hidden)
    print(f"`{command('odometry.hidden')}`: one draw of the filter's noise, seed 0.\n")
    columns = "drive", "camera", "end-point error (m)", "mean error (m)", "speed error meanwhile (m/s)"
    print("\n".join(head(*columns, "90 % coverage of the speed (%)", "of the turn rate (%)")))
    for name in list_kitti_drives(study.root):
        drive = read_kitti_drive(study.root, name, size=(100, 300), cache=None)
        if len(drive) <= FIRST + STEPS:
            continue
        for label, (box, repair) in RUNS.items():
            failures = [CameraFailure("box", FIRST, FIRST + STEPS - 1)] if box else []
            torch.manual_seed(0)
            tracked = track_failing_drive(from_pretrained(study.checkpoint), drive, failures, repair=repair)
            scores, during = drive_scores(tracked), tracked[FIRST : FIRST + STEPS]
            mean, var, true = (during[key][:, 3:] for key in (("belief", "mean"), ("belief", "var"), "state"))
            error = (mean - true)[:, 0].square().mean().sqrt()
            coverage = [f"{100 * share:.0f}" for share in interval_coverage(mean, var, true, level=0.9).tolist()]
            ends = [f"{scores[f'filter_{key}_m']:.1f}" for key in ("end", "mean")]
            print(line(name, label, *ends, f"{error.item():.2f}", *coverage), flush=True)


if __name__ == "__main__":
    main()
