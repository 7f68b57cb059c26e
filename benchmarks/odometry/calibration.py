"""Tells how wrong the speed is for longer than a second, on drives with known poses.

``python -m benchmarks.odometry.calibration --root KITTI --out FOLDER``

The shipped filter has learned from rendered drives alone. How wrong its speed is on real ones, by a factor that lasts,
only real ones can say. Each drive is scored with what the others say; the filter that is left has what all say.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch

from benchmarks.common.arguments import command, parse
from benchmarks.common.tables import head, line
from torch_denkf import from_pretrained, save_pretrained
from torch_denkf.applications.car.kitti.drive import list_kitti_drives
from torch_denkf.applications.car.odometry.evaluation import evaluate_car_filter
from torch_denkf.applications.car.odometry.filter import VELOCITIES, CarFilter
from torch_denkf.applications.car.odometry.streams import Drive, all_frames, read_spans

SECOND = 10  # steps
SLOW = 1.0  # m/s: below it a factor says nothing
NEAREST = 0.05  # of the true speed: a reading that is smaller, or negative, counts as this


@dataclass(frozen=True)
class Calibration:
    """The doubt about a factor on the speed, of each drive by the others, and of all."""

    root: Path  # folder with sequences and poses
    out: Path = Path("runs/calibrated")  # gets the filter, with the doubt that all drives say
    checkpoint: str = "car-odometry"  # that of the library, or a folder that denkf train left
    draws: int = 8  # of the filter's noise


def lasting_square(car: CarFilter, root: Path, name: str) -> float:
    """Mean square of the logarithm of read over true speed, of means over a second each."""
    drive = Drive(root, name, car.settings.size, True, two_view=car.settings.two_view)
    run = all_frames(read_spans(car.sensor, [each.read() for each in drive.spans(1)], car.settings.longest))
    read, true = run["sensor", "ensemble"].mean(1)[1:, 0], run["state"][1:, VELOCITIES[0]]
    moving = true > SLOW
    error = (read / true)[moving].clamp_min(NEAREST).log()
    count = len(error) // SECOND
    return error[: count * SECOND].view(count, SECOND).mean(1).square().mean().item()


def doubted(checkpoint: str, std: float) -> CarFilter:
    """The filter, with a doubt about its factor on the speed."""
    car = from_pretrained(checkpoint)
    car["gain"].log_std.data[0] = torch.tensor(std).log()
    return car


def root_mean(squares: Mapping[str, float]) -> float:
    """Of some drives, each counted alike."""
    return fmean(squares.values()) ** 0.5


def main() -> None:
    """Calibrates, scores, and leaves the filter."""
    study = parse(Calibration)
    torch.set_num_threads(1)
    car, names = from_pretrained(study.checkpoint), list_kitti_drives(study.root)
    squares = {name: lasting_square(car, study.root, name) for name in names}
    made_by = command("odometry.calibration")
    print(f"`{made_by}`. Each drive is scored with the doubt that the others say; empty: shorter than 100 m.\n")
    columns = "drive", "doubt by the others", "m/m", "devkit, %", "v held, %", "turn rate held, %"
    print("\n".join(head(*columns, "sensor: m/m", "devkit, %")))
    for name in names:
        std = root_mean({other: square for other, square in squares.items() if other != name})
        options = {"draws": study.draws, "progress": False}
        rows, _ = evaluate_car_filter(doubted(study.checkpoint, std), study.root, [name], **options)
        found = {row["method"]: row for row in rows}
        errors = [
            text
            for method in ("filter", "dead reckoning")
            for text in (
                f"{found[method]['translation_m_per_m']:.3f}",
                f"{found[method]['devkit_t_rel_percent']:.2f}" if "devkit_t_rel_percent" in found[method] else "",
            )
        ]
        held = [f"{100 * found['filter'][f'coverage90_{key}']:.0f}" for key in ("v", "theta_dot")]
        print(line(name, f"{std:.3f}", *errors[:2], *held, *errors[2:]), flush=True)
    std = root_mean(squares)
    record = {"command": made_by, "drives": names, "doubt": std}
    save_pretrained(doubted(study.checkpoint, std), study.out, training={"calibration": record})
    print(f"by all drives: {std:.3f}; {study.out}")


if __name__ == "__main__":
    main()
