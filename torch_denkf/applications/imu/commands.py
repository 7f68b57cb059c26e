"""``denkf orient``: the orientation of an inertial sensor from its log."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from torch_denkf.cli.command import Command, alone_in, say

if TYPE_CHECKING:
    from numpy import ndarray

__all__ = ["Orient"]

_COLUMNS = {
    "gyro": ("gx", "gy", "gz"),
    "acceleration": ("ax", "ay", "az"),
    "magnetometer": ("mx", "my", "mz"),
}


@dataclass
class Orient(Command):
    """Writes the orientation at each reading of a log with standard deviations, and a figure.

    A log is an .npz file with gyro (rad/s), acceleration (m/s^2), magnetometer (uT), each [T, 3], and rate (Hz); or a
    CSV file with the columns t (s), gx, gy, gz, ax, ay, az, mx, my, mz. Without a magnetometer the heading is relative.
    """

    log: Path  # .npz or .csv
    out: Path  # folder for orientation.csv and orientation.png
    model: str = "imu"  # a filter of the library, or a folder
    smooth: bool = False  # let later readings count, too
    six: bool = False  # leave the magnetometer out

    name, example = "orient", "denkf orient --log walk.npz --out runs/walk"

    def run(self) -> None:
        """Filters, and writes."""
        import numpy as np
        import torch

        from torch_denkf.applications.imu.filter import ImuFilter
        from torch_denkf.applications.imu.log import orientations
        from torch_denkf.applications.imu.pictures import orientation_picture
        from torch_denkf.deployment.files import replacing
        from torch_denkf.pretrained import from_pretrained

        log, rate = read_log(self.log)
        if self.six:
            log.pop("magnetometer", None)
        model = from_pretrained(self.model)
        if not isinstance(model, ImuFilter):
            raise ValueError(f"{self.model} is a {type(model).__name__}; pass imu, or a folder of an ImuFilter")
        torch.set_num_threads(1)
        values = {name: torch.as_tensor(value) for name, value in log.items()}
        found = orientations(model.double(), **values, rate=rate, smooth=self.smooth)
        degrees = found.std.rad2deg()
        seconds = torch.arange(len(degrees), dtype=degrees.dtype).unsqueeze(-1) / rate
        with alone_in(self.out):
            table = torch.cat([seconds, found.quaternion, degrees], -1).numpy()
            with replacing(self.out / "orientation.csv") as file:
                header = "t,w,x,y,z,std_x_deg,std_y_deg,std_heading_deg"
                np.savetxt(file, table, fmt="%.6f", delimiter=",", header=header, comments="")
            with replacing(self.out / "orientation.png") as file:
                orientation_picture(found, rate).savefig(file, format="png", dpi=120)
        say(f"{len(table)} orientations in {self.out / 'orientation.csv'}, picture in {self.out / 'orientation.png'}")


def read_log(file: Path) -> tuple[dict[str, ndarray], float]:
    """Loads the readings of a log ``[T, 3]`` by name, in float64, and their rate in Hz.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no log, or the times of a CSV file are not equidistant.
    """
    import numpy as np

    if file.suffix == ".npz":
        with np.load(file) as data:
            missing = {"gyro", "acceleration", "rate"} - set(data.files)
            if missing:
                raise ValueError(f"{file} lacks {sorted(missing)}; it has {data.files}")
            return {name: data[name].astype(float) for name in _COLUMNS if name in data.files}, float(data["rate"])
    table = np.genfromtxt(file, delimiter=",", names=True, dtype=float)
    names = table.dtype.names or ()
    log = {name: each for name, each in _COLUMNS.items() if set(each) <= set(names)}
    if "t" not in names or "gyro" not in log or "acceleration" not in log:
        raise ValueError(f"{file} needs the columns t, gx, gy, gz, ax, ay, az; it has {', '.join(names) or 'none'}")
    partial = [c for name, each in _COLUMNS.items() if name not in log for c in each if c in names]
    if partial:
        raise ValueError(f"{file} has {', '.join(partial)} but not all three; add the others, or leave them out")
    steps = np.diff(table["t"])
    middle = np.median(steps) if len(steps) else 0.0
    if not (middle > 0 and steps.min() > 0.5 * middle and steps.max() < 1.5 * middle):
        raise ValueError(f"the times t of {file} are to be even, in s; fill gaps by interpolation, or cut the log")
    return {n: np.stack([table[c] for c in each], -1) for n, each in log.items()}, 1 / steps.mean()
