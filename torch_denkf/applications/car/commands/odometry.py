"""``denkf odometry``: the path of a car, from the images of its camera.

::

    denkf odometry drive.mp4 --calibration camera.yaml --checkpoint runs/car --out runs/drive
    denkf odometry KITTI/sequences/09/image_0 --calibration KITTI/sequences/09/calib.txt \
        --times KITTI/sequences/09/times.txt --checkpoint runs/car --out runs/09

Writes ``path.csv`` (pose, velocities, and standard deviations of all), ``path_kitti.txt`` and ``path_tum.txt`` (which
evo reads), and plots if matplotlib is installed. See :func:`torch_denkf.applications.car.track`, which does the
work.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import median

from tyro.conf import Positional

from torch_denkf._checks import check_count
from torch_denkf.applications.car.vision.camera import KITTI_HEIGHT
from torch_denkf.cli.command import Command, alone_in, say
from torch_denkf.deployment.progress import progress_bar

__all__ = ["Odometry"]

#: Tolerance of the time between frames, as a share of the median; containers round to milliseconds.
_UNEVEN = 0.2


@dataclass
class Odometry(Command):
    """The path of a car, with its uncertainty, from the images of one camera whose calibration and height are known."""

    frames: Positional[Path]  # folder of images, in the order of names; or a video
    calibration: Path  # KITTI's calib.txt; or a text or YAML file: fx, fy, cx, cy in pixels
    out: Path  # folder for path.csv, trajectory files and pictures
    checkpoint: str = "car-odometry"  # a pretrained filter, or a folder of denkf train
    camera: str | None = None  # of calib.txt; the name of the folder, where that is image_0 to image_3
    fps: float | None = None  # frames in a second; by default that of a video, or the times of its frames
    times: Path | None = None  # file with a time in s for each frame, a row each
    height: float = KITTI_HEIGHT  # of the camera over the road, m: it scales the path
    pitch: float = 0.0  # upward pitch of the camera, rad
    seed: int = 0  # of the filter's noise
    black_level: int | None = 8  # frames whose grey values span at most this much of 255 are missing
    repair: bool = True  # do not continue the flow over static occlusions
    pictures: bool = True  # leave the pictures out
    threads: int = 1  # of torch and OpenCV

    name = "odometry"
    example = "denkf odometry drive.mp4 --calibration camera.yaml --checkpoint runs/car --height 1.4 --out runs/drive"

    def run(self) -> None:
        """Reads the inputs, tracks, and writes the path step by step."""
        if self.fps is not None and self.times is not None:
            raise ValueError("pass --fps or --times, not both")
        given = {"frames": self.frames, "calibration": self.calibration, "times": self.times}
        missing = [f"{name} {path}" for name, path in given.items() if path is not None and not path.exists()]
        if missing:
            raise FileNotFoundError(f"there is no such file or folder: {', '.join(missing)}")
        check_count("--seed", self.seed, least=0)
        from torch_denkf.applications.car.commands._car import load_car, set_threads
        from torch_denkf.applications.car.odometry.images import read_camera, read_frames
        from torch_denkf.applications.car.odometry.tracking import track

        set_threads(self.threads)
        source = read_frames(self.frames)
        folder = self.frames.name if self.frames.name in {f"image_{n}" for n in range(4)} else None
        calibration = read_camera(self.calibration, self.camera or folder)
        times, fps = _times(self.times, source), source.fps if self.fps is None else self.fps
        if times is None and self.fps is None:
            times = _uneven(source)
        if times is None and fps is None:
            raise ValueError(
                f"{self.frames} does not say when its frames were taken; pass --fps NUMBER or --times FILE"
            )
        beliefs = track(
            load_car(self.checkpoint),
            _counted(source),
            calibration,
            times=times,
            fps=None if times is not None else fps,
            height=self.height,
            pitch=self.pitch,
            black_level=self.black_level,
            repair=self.repair,
            seed=self.seed,
        )
        with alone_in(self.out):
            _leave(beliefs, self.out, pictures=self.pictures)


def _leave(beliefs, out: Path, *, pictures: bool) -> None:
    """Writes the path step by step, then trajectory files, a summary and plots."""
    import torch

    from torch_denkf.applications.car.kitti.trajectories import write_trajectory
    from torch_denkf.applications.car.odometry.paths import write_path

    means, seconds, blind, doubt, hidden = [], [], -1, 0.0, {}  # the first belief has no reading
    for belief in write_path(beliefs, out / "path.csv"):
        means.append(belief.mean)
        seconds.append(belief.time)
        blind += not belief.observed
        if belief.hidden:
            hidden[belief.frame] = belief.hidden
        doubt = float(belief.var[:2].sum().sqrt())
    states = torch.stack(means)
    write_trajectory(out / "path_kitti.txt", states, layout="kitti")
    write_trajectory(out / "path_tum.txt", states, torch.tensor(seconds, dtype=torch.float64), layout="tum")
    way = float(states[1:, :2].sub(states[:-1, :2]).norm(dim=-1).sum())
    say(
        f"{way:.1f} m in {seconds[-1] - seconds[0]:.1f} s, {len(states)} steps, {blind} without a reading; "
        f"at the end x {float(states[-1, 0]):.1f} m, y {float(states[-1, 1]):.1f} m, heading "
        f"{math.degrees(float(states[-1, 2])):.1f} deg, uncertain by {doubt:.1f} m (one standard deviation)"
    )
    if hidden:
        say(
            f"Something stands still before the camera in {len(hidden)} frames, {min(hidden)} to {max(hidden)}: dirt, "
            f"or a box. It hides at most {100 * max(hidden.values()):.0f} % of the picture; see the column hidden of "
            "path.csv."
        )
    files = ["path.csv", "path_kitti.txt", "path_tum.txt"]
    if pictures:
        try:
            from torch_denkf.applications.car.commands.plot import draw

            files += [file.name for file in draw(out / "path.csv", out)]
        except ImportError as error:
            say(f"no pictures: {error}")
    say(f"{out}: {', '.join(files)}")


def _times(file: Path | None, source) -> Sequence[float] | None:
    """Returns the frames' times; for numbered frames, the rows of a file with those numbers."""
    if file is None:
        return None
    from torch_denkf.applications.car.odometry.images import read_times

    times = read_times(file)
    if source.count is None or len(times) == source.count:
        return times
    if source.first and len(times) >= source.first + source.count:
        return times[source.first : source.first + source.count]
    numbered = f", numbered from {source.first}" if source.first else ""
    raise ValueError(
        f"{file} has {len(times)} times, but {source.path} has {source.count} frames{numbered}; pass a row for each"
    )


def _uneven(source) -> Sequence[float] | None:
    """Returns the time stamps of a video's frames, if they are not evenly spaced."""
    stamps = source.stamps()
    if stamps is None:
        return None
    gaps = [after - before for before, after in pairwise(stamps)]
    usual = median(gaps)
    off = sum(abs(gap - usual) > _UNEVEN * usual for gap in gaps)
    if off:
        warnings.warn(
            f"{source.path}: {off} of {len(gaps)} frames come earlier or later than {usual:.3g} s after the one before "
            f"(at most {max(gaps):.3g} s); the times in the file are used. Pass --fps to take them as even.",
            stacklevel=2,
        )
    return stamps if off or source.fps is None else None


def _counted(source):
    with progress_bar("odometry", source.count, unit=" frames") as bar:
        for frame in source:
            yield frame
            bar.update()
