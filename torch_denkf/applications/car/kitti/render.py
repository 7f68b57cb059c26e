"""Rendered drives in KITTI's layout: data that comes with the library, for tests, examples and first experiments.

A car drives between houses, trees and parked cars, along a random road or along the poses of a recorded drive.
:mod:`torch_denkf.applications.car.street.renderer` draws; ``denkf render-kitti`` is the command.
"""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np

from torch_denkf.applications.car.kitti.altitude import steady_altitude
from torch_denkf.applications.car.kitti.files import read_poses
from torch_denkf.applications.car.kitti.writer import FORMAT, Job, write
from torch_denkf.applications.car.street.camera import KITTI_FOCAL, Camera
from torch_denkf.applications.car.street.path import check_length
from torch_denkf.applications.car.street.random_drive import hilly_poses, random_drive
from torch_denkf.applications.car.street.roadside import roadside_scene
from torch_denkf.applications.car.vision.poses import state_to_poses

__all__ = ["random_drive", "render_drives", "roadside_scene", "write_drives"]

FRAMES = 300  # length of a random drive
GREY_OR_COLOUR = ("image_2", "image_0")


def render_drives(
    out: str | Path,
    *,
    poses: str | Path | None = None,
    names: str | Iterable[str] | None = None,
    size: tuple[int, int] = (50, 150),
    frames: int | None = None,
    seed: int = 0,
    camera: str = "image_2",
    focal: float = KITTI_FOCAL,
    traffic: bool = True,
    processes: int | None = 1,
    overwrite: bool = False,
    progress: Callable[[int], object] | None = None,
) -> list[str]:
    """Renders drives along recorded or random poses, with hills and moving cars, in KITTI's layout.

    The camera has the poses' full motion, with pitch, roll and climbs (without climbs that contradict its attitude,
    because recorded altitudes drift while a car stands); the road is 1.65 m below it and follows the hills. Frames are
    0.103 s apart. A drive is determined by its name, its poses, the seed and the options, not by the number of
    processes. Finished drives with the same options are kept, so that an interrupted call can be repeated; a drive that
    exists is always complete.

    Args:
        out: folder to write ``sequences/NAME/image_2``, ``calib.txt``, ``times.txt`` and ``poses/NAME.txt`` to.
        poses: folder of pose files ``NAME.txt``, a 3 x 4 camera-to-world matrix a row, such as the eleven of the
            odometry benchmark. Without it the drives are random, see :func:`random_drive`.
        names: names of the drives, or one name; by default all pose files, or ``"00"`` to ``"10"`` for random drives.
        size: (H, W) of the images.
        frames: largest number of images per drive; by default all poses, or 300 for random drives.
        seed: another seed gives other scenes (and other random drives) of the same names.
        camera: ``image_2`` writes colour images, ``image_0`` grey ones.
        focal: focal length relative to the width; a value other than KITTI's gives other intrinsics.
        traffic: whether there are moving cars and a varying exposure.
        processes: number of parallel processes; 1 draws in this process, None stands for one per core. More than one
            needs the caller's script to be importable, with ``if __name__ == "__main__":``.
        overwrite: replace drives of other options. Only rendered drives are ever replaced.
        progress: called with the number of images that were written since the last call.

    Returns:
        The names.

    Raises:
        FileNotFoundError: if there are no pose files, or a requested one is missing.
        ValueError: for malformed pose rows (naming file and line), drives of more than 50 km, fewer than two frames, a
            name that is not a plain folder name, and options out of range.
        FileExistsError: if there is another drive of that name.
        OSError: if ``out`` cannot be written to.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> render_drives(folder, names=["a", "b"], frames=4, camera="image_0")
        ['a', 'b']
        >>> from torch_denkf.applications.car.kitti.drive import read_kitti_drive
        >>> read_kitti_drive(folder, "a", colour=None, cache=None)["image"].shape
        torch.Size([4, 1, 50, 150])
    """
    out = Path(out).expanduser()
    size = _checked_size(size)
    if camera not in GREY_OR_COLOUR:
        raise ValueError(f"camera is one of {list(GREY_OR_COLOUR)}, got {camera!r}")
    if not 0.2 <= focal <= 3:
        raise ValueError(f"focal is the focal length as a share of the width, 0.2 to 3 (KITTI: 0.579), got {focal}")
    if processes is not None and processes < 1:
        raise ValueError(f"processes must be at least 1, got {processes}")
    if isinstance(names, str):
        names = [names]
    if poses is None:
        names = [f"{k:02d}" for k in range(11)] if names is None else list(names)
        _check(names, FRAMES if frames is None else frames)
        tracks = {name: _invent(name, FRAMES if frames is None else frames, seed) for name in names}
    else:
        names = _pose_files(Path(poses).expanduser(), names)
        folder = Path(poses).expanduser()
        tracks = {name: steady_altitude(read_poses(folder / f"{name}.txt")[:frames]) for name in names}
        for name in names:
            _check([name], len(tracks[name]))
            check_length(f"{folder / name}.txt", tracks[name][:, :, 3])
    jobs = []
    for name, track in tracks.items():
        options = {
            "format": FORMAT,
            "frames": len(track),
            "size": list(size),
            "seed": seed,
            "camera": camera,
            "focal": round(focal, 9),
            "traffic": traffic,
            "poses": hashlib.sha256(np.round(track, 6).tobytes()).hexdigest()[:16],
        }
        job = Job(out, name, track, Camera.odometry(size, focal), camera, traffic, options)
        if job.is_there(overwrite):
            if progress is not None:
                progress(len(track))
        else:
            jobs.append(job)
    write(jobs, processes or os.cpu_count() or 1, progress)
    return names


def _invent(name: str, frames: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
    return hilly_poses(random_drive(frames, rng), rng)


def _pose_files(folder: Path, names: Iterable[str] | None) -> list[str]:
    there = sorted(file.stem for file in folder.glob("*.txt"))
    if not there:
        raise FileNotFoundError(f"no pose files NAME.txt in {folder}; pass the folder that holds 00.txt, 01.txt ...")
    if names is None:
        return there
    names = list(names)
    if missing := [name for name in names if name not in there]:
        raise FileNotFoundError(f"no pose files for {missing} in {folder}; it has {there}")
    return names


def _check(names: list[str], frames: int) -> None:
    if frames < 2:
        raise ValueError(f"a drive needs at least 2 frames, got {frames}")
    for name in names:
        if not name or Path(name).name != name:
            raise ValueError(f"a drive's name becomes a folder's, such as 'town'; got {name!r}")


def _checked_size(size: tuple[int, int]) -> tuple[int, int]:
    height, width = (int(side) for side in size)
    if height < 4 or width < 4:
        raise ValueError(f"size is (height, width) in pixels, at least 4 x 4, got {tuple(size)}")
    return height, width


def write_drives(
    root: str | Path,
    names: str | Iterable[str],
    *,
    frames: int = FRAMES,
    size: tuple[int, int] = (50, 150),
    seed: int = 0,
    overwrite: bool = False,
) -> list[str]:
    """Renders simple drives: random roads on level ground, with a level camera and without moving cars.

    They have the layout of :func:`torch_denkf.applications.car.read_kitti_drive`. A drive is determined by its name,
    the seed and the options, so that an existing drive with the same options is kept. Writing 300 frames of 50 x 150
    takes about two seconds. The image noise is 1.5 grey values. :func:`render_drives` renders harder drives.

    Args:
        root: folder to write ``sequences/NAME/image_2``, ``calib.txt``, ``times.txt`` and ``poses/NAME.txt`` to.
        names: names of the drives, or one name; each is another road.
        frames: images of a drive, at 0.103 s.
        size: (H, W) of the images; the field of view is KITTI's.
        seed: another seed gives other drives of the same names.
        overwrite: replace drives of other options. Only drives that this function wrote are ever replaced.

    Returns:
        The names.

    Raises:
        ValueError: for fewer than two frames, a name that is not a plain folder name, or a size below 4 x 4.
        FileExistsError: if there is another drive of that name.
        OSError: if ``root`` cannot be written to.

    Examples:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> write_drives(folder, ["town"], frames=5)
        ['town']
        >>> from torch_denkf.applications.car.kitti.drive import read_kitti_drive
        >>> read_kitti_drive(folder, "town", cache=None)["image"].shape
        torch.Size([5, 3, 50, 150])
    """
    root, names = Path(root).expanduser(), [names] if isinstance(names, str) else list(names)
    size = _checked_size(size)
    _check(names, frames)
    for name in names:  # one by one, so that drives before a failing one are complete
        options = {"format": FORMAT, "frames": frames, "size": list(size), "seed": seed}
        rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
        track = state_to_poses(random_drive(frames, rng))
        job = Job(root, name, track, Camera.kitti(size), "image_2", False, options)
        if not job.is_there(overwrite):
            write([job], 1)
    return names
