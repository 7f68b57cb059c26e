"""Measures the cost of gating without sensor faults: ``python -m benchmarks.monitor.responses --root RENDERED``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import head, line
from benchmarks.monitor.drives import believed_spans, car_filter, failing, filtered, from_truth
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.filters import Filter
from torch_denkf.functional import wrap_angles
from torch_denkf.monitoring import Gated

DRAWS = 8


@dataclass(frozen=True)
class Responses:
    """Options of the comparison of gates on drives without faults; half of the drives calibrate the gates."""

    root: Path  # drives that `denkf render-kitti` wrote
    out: Path = Path("runs/monitor")  # folder for optical flow, signs and readings
    drives: int = 8


def degrees(filter: Filter, drives: list[TensorDict]) -> Tensor:
    """Returns the mean absolute heading error of each drive, in degrees."""
    off = [
        one["belief", "mean"][..., 2] - drive["state"][:, 2]
        for one, drive in zip(filtered(filter, drives, DRAWS), drives, strict=True)
    ]
    return torch.stack([wrap_angles(angle).abs().mean().rad2deg() for angle in off])


def main() -> None:
    """Prints the table."""
    study = parse(Responses)
    model, drives = car_filter()[1], []
    for name in list_kitti_drives(study.root)[: study.drives]:
        reading = failing(study.root, name, "clean", study.out / "readings")
        drives.append(believed_spans([reading], lambda one: one["observed"]))
    known, test = drives[::2], drives[1::2]
    print(f"`{command('monitor.responses')}`\n")
    print("\n".join(head("gate", "heading error (deg), mean of the drives", "worst drive")))
    for name in ("no gate", "student", "huber", "reject"):
        filter = model if name == "no gate" else Gated(model, 2, response=name).calibrate(list(map(from_truth, known)))
        off = degrees(filter, test)
        print(line(name, f"{off.mean():.2f}", f"{off.max():.2f}"), flush=True)


if __name__ == "__main__":
    main()
