"""Estimates coloured errors of speed and turn rate on drives with known poses.

``python -m benchmarks.odometry.calibration --root KITTI --out FOLDER``

The shipped filter was trained on rendered drives alone. The scale error of its speed and the bias of its turn rate,
each averaged over one second, are estimated on real drives. Each drive is scored with the estimates of the others; the
saved filter has those of all.
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
SLOW = 1.0  # m/s: lower speeds are not used to estimate the scale
NEAREST = 0.05  # share of the true speed at which smaller or negative readings are clamped


@dataclass(frozen=True)
class Calibration:
    """Options of the calibration of the speed's scale error and the turn rate's bias, for each drive on the others."""

    root: Path  # folder with sequences and poses
    out: Path = Path("runs/calibrated")  # folder for the filter, calibrated on all drives
    checkpoint: str = "car-odometry"  # a pretrained filter, or a folder of denkf train
    draws: int = 8  # of the filter's noise


def lasting_squares(car: CarFilter, root: Path, name: str) -> Tensor:
    """Returns mean squares ``[2]`` of one-second means: the log scale error of the speed, the turn rate error."""
    drive = Drive(root, name, car.settings.size, True, two_view=car.settings.two_view)
    run = all_frames(read_spans(car.sensor, [each.read() for each in drive.spans(1)], car.settings.longest))
    read, true = run["sensor", "ensemble"].mean(1)[1:], run["state"][1:, VELOCITIES]
    moving = true[:, 0] > SLOW
    factor = (read / true)[moving, 0].clamp_min(NEAREST).log()
    errors = factor, (read - true)[:, 1]
    seconds = [error[: len(error) // SECOND * SECOND].view(-1, SECOND).mean(1) for error in errors]
    return torch.stack([means.square().mean() for means in seconds])


def with_bias_stds(checkpoint: str, factor: float, offset: float) -> CarFilter:
    """Returns the filter with standard deviations of the speed's scale error and the turn rate's bias."""
    car = from_pretrained(checkpoint)
    car["gain"].log_std.data[0] = torch.tensor(factor).log()
    car["gain"].offset_std[1] = offset
    return car


def root_mean(squares: Iterable[Tensor]) -> list[float]:
    """Returns root mean squares over drives, with equal weights."""
    return torch.stack(list(squares)).mean(0).sqrt().tolist()


def main() -> None:
    """Calibrates, scores, and saves the filter."""
    study = parse(Calibration)
    torch.set_num_threads(1)
    car, names = from_pretrained(study.checkpoint), list_kitti_drives(study.root)
    squares = {name: lasting_squares(car, study.root, name) for name in names}
    made_by = command("odometry.calibration")
    print(
        f"`{made_by}`. Each drive is scored with the standard deviations of the other drives. "
        "Drives shorter than 100 m have no devkit error.\n"
    )
    columns = "drive", "std of the others: scale", "turn rate (mrad/s)", "m/m", "devkit, %"
    coverage = "coverage of v (%)", "coverage of the turn rate (%)"
    print("\n".join(head(*columns, *coverage, "sensor: m/m", "devkit, %")))
    for name in names:
        factor, offset = root_mean(square for other, square in squares.items() if other != name)
        options = {"draws": study.draws, "progress": False}
        rows, _ = evaluate_car_filter(with_bias_stds(study.checkpoint, factor, offset), study.root, [name], **options)
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
    save_pretrained(with_bias_stds(study.checkpoint, factor, offset), study.out, training={"calibration": record})
    print(f"by all drives: {factor:.3f}, {1e3 * offset:.1f} mrad/s; {study.out}")


if __name__ == "__main__":
    main()
