"""Tells how wrong speed and turn rate are for longer than a second, on drives with known poses.

``python -m benchmarks.odometry.calibration --root KITTI --out FOLDER``

The shipped filter has learned from rendered drives alone. How wrong its speed is on real ones, by a factor that lasts,
and its turn rate, by an offset that lasts, only real ones can say. Each drive is scored with what the others say; the
filter that is left has what all say.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

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
    """Calibrates the doubt about a factor on the speed and an offset of the turn rate, for each drive by the others."""

    root: Path  # folder with sequences and poses
    out: Path = Path("runs/calibrated")  # gets the filter, with the doubt that all drives say
    checkpoint: str = "car-odometry"  # that of the library, or a folder that denkf train left
    draws: int = 8  # of the filter's noise


def lasting_squares(car: CarFilter, root: Path, name: str) -> Tensor:
    """Mean squares ``[2]`` of means over a second: the logarithm of read over true speed, the turn rate's error."""
    drive = Drive(root, name, car.settings.size, True, two_view=car.settings.two_view)
    run = all_frames(read_spans(car.sensor, [each.read() for each in drive.spans(1)], car.settings.longest))
    read, true = run["sensor", "ensemble"].mean(1)[1:], run["state"][1:, VELOCITIES]
    moving = true[:, 0] > SLOW
    factor = (read / true)[moving, 0].clamp_min(NEAREST).log()
    errors = factor, (read - true)[:, 1]
    seconds = [error[: len(error) // SECOND * SECOND].view(-1, SECOND).mean(1) for error in errors]
    return torch.stack([means.square().mean() for means in seconds])


def doubted(checkpoint: str, factor: float, offset: float) -> CarFilter:
    """The filter, with a doubt about its factor on the speed and about an offset of its turn rate."""
    car = from_pretrained(checkpoint)
    car["gain"].log_std.data[0] = torch.tensor(factor).log()
    car["gain"].offset_std[1] = offset
    return car


def root_mean(squares: Iterable[Tensor]) -> list[float]:
    """Root mean squares over some drives, each counted alike."""
    return torch.stack(list(squares)).mean(0).sqrt().tolist()


def main() -> None:
    """Calibrates, scores, and leaves the filter."""
    study = parse(Calibration)
    torch.set_num_threads(1)
    car, names = from_pretrained(study.checkpoint), list_kitti_drives(study.root)
    squares = {name: lasting_squares(car, study.root, name) for name in names}
    made_by = command("odometry.calibration")
    print(f"`{made_by}`. Each drive is scored with the doubt that the others say; empty: shorter than 100 m.\n")
    columns = (
        "drive",
        "doubt by the others: speed",
        "turn rate, mrad/s",
        "m/m",
        "devkit, %",
        "v held, %",
        "turn held, %",
    )
    print("\n".join(head(*columns, "sensor: m/m", "devkit, %")))
    for name in names:
        factor, offset = root_mean(square for other, square in squares.items() if other != name)
        options = {"draws": study.draws, "progress": False}
        rows, _ = evaluate_car_filter(doubted(study.checkpoint, factor, offset), study.root, [name], **options)
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
        print(line(name, f"{factor:.3f}", f"{1e3 * offset:.1f}", *errors[:2], *held, *errors[2:]), flush=True)
    factor, offset = root_mean(squares.values())
    record = {"command": made_by, "drives": names, "doubt": factor, "offset": offset}
    save_pretrained(doubted(study.checkpoint, factor, offset), study.out, training={"calibration": record})
    print(f"by all drives: {factor:.3f}, {1e3 * offset:.1f} mrad/s; {study.out}")


if __name__ == "__main__":
    main()
