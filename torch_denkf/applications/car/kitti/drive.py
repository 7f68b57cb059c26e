"""Reader of drives in the layout of KITTI's odometry benchmark.

::

    root/sequences/NN/image_{0..3}/FFFFFF.png    left grey, right grey, left colour, right colour
    root/sequences/NN/calib.txt, times.txt
    root/poses/NN.txt                            camera-to-world, a row a frame, the first for frame 000000

The images are not part of this library: (c) Geiger, Lenz, Stiller & Urtasun, CC BY-NC-SA 3.0,
cvlibs.net/datasets/kitti. :func:`torch_denkf.applications.car.write_drives` writes rendered drives in the same layout.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.applications.car.kitti.clock import read_times
from torch_denkf.applications.car.kitti.files import check_speeds, read_calibration, read_poses, scale_calibration
from torch_denkf.applications.car.vision.poses import poses_to_state
from torch_denkf.data.cache import cache_folder, cached, stamp
from torch_denkf.data.pictures import check_size, decode_picture, scaled, text_of_size

__all__ = ["list_kitti_drives", "read_kitti_drive"]

CAMERAS = ("image_2", "image_0", "image_3", "image_1")
_FORMAT = 3  # part of the cache's key: raise it when the stored content changes


def list_kitti_drives(root: str | Path) -> list[str]:
    """Returns names of the sequences that have both images and poses.

    Args:
        root: folder with ``sequences`` and ``poses``.

    Returns:
        Names to pass to :func:`read_kitti_drive`, sorted.

    Raises:
        FileNotFoundError: if there is no folder ``root/sequences``.
    """
    folder = Path(root) / "sequences"
    if not folder.is_dir():
        raise FileNotFoundError(f"no folder {folder}; pass the folder that holds 'sequences' and 'poses'")
    return sorted(
        entry.name
        for entry in folder.iterdir()
        if (Path(root) / "poses" / f"{entry.name}.txt").is_file()
        and any(_frame_files(entry / camera) for camera in CAMERAS)
    )


def read_kitti_drive(
    root: str | Path,
    sequence: str | int,
    *,
    camera: str | None = None,
    size: tuple[int, int] = (50, 150),
    colour: bool | None = True,
    cache: str | Path | bool | None = True,
    progress: Callable[[int], object] | None = None,
) -> TensorDict:
    """Reads one drive: images of one size, and the planar state in Kloss et al.'s convention.

    Row k is frame ``first + k``, from the first to the last frame that has both an image and a pose. Frames without an
    image, or with a damaged file (a warning names it), keep their row. Frames whose time does not increase keep their
    row, too, and count as missing; warnings count them and the gaps.

    ================= ========== ================================================================================
    key               shape      content
    ================= ========== ================================================================================
    ``image``         [N,C,H,W]  uint8, RGB or grey; zeros if the frame is missing
    ``frame_valid``   [N,1]      bool: there is an image with a valid time
    ``state``         [N,5]      float32: x m (forward at frame 0), y m (left), θ rad (to the left, unwrapped),
                                 v m/s, θ_dot rad/s
    ``time``          [N,1]      float64, s
    ``dt``            [N,1]      float32, s: the drive's median frame time; in a row after a gap the time since the
                                 row before
    ``frame``         [N,1]      int64, the frame's number
    ``calibration``   [N,4]      float32: fx, fy, cx, cy in pixels of ``size``, the same in all rows
    ================= ========== ================================================================================

    v and θ_dot of row t are **backward** differences, the motion from frame t-1 to t, as the image pair (t-1, t) shows
    it. The first pose of the file has the velocities of the next. v is signed: negative in reverse. After a gap both
    are means over the gap, which no image pair crosses.

    The decoded drive is cached as a memory-mapped TensorDict, whose key covers the folder, the options, and the names,
    times and sizes of all files. Old entries may be deleted at any time.

    Args:
        root: folder with ``sequences`` and ``poses``.
        sequence: name of the sequence, such as ``"09"`` or 9.
        camera: folder of the images; by default the first of ``image_2``, ``image_0``, ``image_3`` and ``image_1``
            that has any.
        size: (H, W) to scale the images to.
        colour: True gives three channels, in which grey images are repeated so that one network takes both; False gives
            one grey channel; None keeps the channels of the files.
        cache: folder of the cache; True for ``$TORCH_DENKF_CACHE`` or else ``~/.cache/torch_denkf``; None or False
            for none: the drive is then in memory.
        progress: called with the number of images that were decoded since the last call; never for a cached drive.

    Returns:
        The drive, batch size ``[N]``.

    Raises:
        FileNotFoundError: without the sequence's folder, images, poses or calibration.
        ValueError: for malformed rows, matrices that are no rotations, jumps of the position, focal lengths that are
            not positive, times that are not in seconds or of which more than a tenth do not increase, images with other
            names or without any pose, drives without a readable image or with images of different sizes, and sizes that
            are not positive.
        OSError: if the cache cannot be written.

    Examples:
        >>> drive = read_kitti_drive("data/kitti", "09")  # doctest: +SKIP
        >>> drive["image"].shape, drive["state"].shape  # doctest: +SKIP
        (torch.Size([1591, 3, 50, 150]), torch.Size([1591, 5]))
    """
    root = Path(root).expanduser().resolve()
    sequence = f"{sequence:02d}" if isinstance(sequence, int) else sequence
    for name, value in (("sequence", sequence), ("camera", camera)):
        if not isinstance(value, str) and (name == "sequence" or value is not None):
            raise TypeError(f"{name} is a name, such as {'09' if name == 'sequence' else 'image_2'!r}; got {value!r}")
    if colour is not None and not isinstance(colour, bool):
        raise TypeError(f"colour is True, False or None; got {colour!r}")
    height, width = check_size(size)
    folder, poses = root / "sequences" / sequence, root / "poses" / f"{sequence}.txt"
    camera = choose_camera(folder, camera)
    files = _frame_files(folder / camera)
    if not files:
        raise FileNotFoundError(f"no images FFFFFF.png in {folder / camera}; pass another camera, or download them")

    odd = [file for number, file in files.items() if file.name != f"{number:06d}.png"]
    if odd:
        raise ValueError(
            f"{odd[0]} is not named as a frame, FFFFFF.png, nor are {len(odd) - 1} others; if it is frame "
            f"{int(odd[0].stem)}, rename it to {int(odd[0].stem):06d}.png"
        )

    def read() -> TensorDict:
        return _read(folder, poses, camera, files, (height, width), colour, progress)

    directory = cache_folder(cache)
    if directory is None:
        return read()
    texts = [poses, folder / "calib.txt", folder / "times.txt"]
    key = [_FORMAT, str(root), sequence, camera, height, width, colour]
    key += [(path.name, *stamp(path)) for path in [*texts, *files.values()]]
    digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:16]
    return cached(directory / f"{sequence}-{camera}-{height}x{width}-{digest}", read)


def choose_camera(folder: Path, camera: str | None) -> str:
    """Returns the name of a drive's image folder: the requested one, or the first that has images."""
    if not folder.is_dir():
        names = sorted(e.name for e in folder.parent.iterdir() if e.is_dir()) if folder.parent.is_dir() else []
        raise FileNotFoundError(
            f"no folder {folder}; "
            + (f"{folder.parent} has {names}" if names else "pass the folder that holds 'sequences' and 'poses'")
        )
    if camera is not None:
        if not (folder / camera).is_dir():
            raise FileNotFoundError(f"no folder {folder / camera}; pass another camera or None for the first there is")
        return camera
    for name in CAMERAS:
        if _frame_files(folder / name):
            return name
    raise FileNotFoundError(
        f"no images in {folder}; expected FFFFFF.png in one of {list(CAMERAS)} (from cvlibs.net/datasets/kitti, or "
        "rendered by torch_denkf.applications.car.write_drives)"
    )


def _frame_files(folder: Path) -> dict[int, Path]:
    """Returns images by frame number, in order."""
    if not folder.is_dir():
        return {}
    names = sorted(entry.name for entry in os.scandir(folder) if re.fullmatch(r"\d+\.png", entry.name))
    return {int(name[:-4]): folder / name for name in names}


def _read(
    folder: Path,
    poses_file: Path,
    camera: str,
    files: dict[int, Path],
    size: tuple[int, int],
    colour: bool | None,
    progress: Callable[[int], object] | None,
) -> TensorDict:
    poses = read_poses(poses_file)
    numbers = [number for number in files if number < len(poses)]
    if not numbers:
        raise ValueError(
            f"{poses_file} has {len(poses)} poses, for frames 0 to {len(poses) - 1}, but the first image in "
            f"{folder / camera} is number {min(files)}; the first pose row belongs to frame 000000"
        )
    if len(numbers) < len(files):
        warnings.warn(
            f"{poses_file} has {len(poses)} poses; {len(files) - len(numbers)} of {len(files)} images in "
            f"{folder / camera} come after them and are left out. Is the file cut?",
            stacklevel=4,
        )
    first, last = min(numbers), max(numbers)
    rows = last - first + 1
    clock = read_times(folder / "times.txt", last + 1)
    dt = clock.dt[first:].copy()
    dt[0] = clock.median
    check_speeds(poses_file, poses[: last + 1], np.maximum(clock.dt[1:], clock.median))
    state = poses_to_state(poses[: last + 1], clock.dt[1:])[first:]
    if colour is None:
        colour = _is_colour(files[number] for number in numbers)
    image = np.zeros((rows, 3 if colour else 1, *size), dtype=np.uint8)
    valid = np.zeros((rows, 1), dtype=bool)
    native, first_file = None, None
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:  # OpenCV decodes without the GIL
        frames = pool.map(lambda number: _read_image(files[number], size, colour), numbers)
        try:
            for number, (pixels, shape) in zip(numbers, frames, strict=True):
                if progress is not None:
                    progress(1)
                if pixels is None:
                    warnings.warn(
                        f"{files[number]} is not a complete PNG image; its frame counts as missing (frame_valid False)",
                        stacklevel=4,
                    )
                    continue
                if native is None:
                    native, first_file = shape, files[number]
                elif shape != native:
                    raise ValueError(
                        f"{files[number]} is {text_of_size(shape)}, but {first_file} is {text_of_size(native)}; the "
                        "images of a drive have one size, that of its calibration: scale this one or take it away"
                    )
                if clock.sound[number]:
                    image[number - first], valid[number - first] = pixels, True
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)  # otherwise thousands of images would still be decoded
            raise
    if native is None:
        raise ValueError(f"none of the {len(numbers)} images in {folder / camera} can be read; download them again")
    calibration = scale_calibration(read_calibration(folder / "calib.txt", camera), native, size)
    return TensorDict(
        {
            "image": torch.from_numpy(image),
            "frame_valid": torch.from_numpy(valid),
            "state": torch.from_numpy(state).float(),
            "time": torch.from_numpy(clock.times[first:, None].copy()),
            "dt": torch.from_numpy(dt[:, None]).float(),
            "frame": torch.arange(first, last + 1).unsqueeze(-1),
            "calibration": torch.from_numpy(calibration).float().repeat(rows, 1),
        },
        batch_size=[rows],
    )


def _decode(file: Path, flags: int) -> np.ndarray | None:
    return decode_picture(file.read_bytes(), flags) if file.is_file() else None  # None for a folder or a broken link


def _is_colour(files) -> bool:
    pixels = next((image for file in files if (image := _decode(file, cv2.IMREAD_ANYCOLOR)) is not None), None)
    return pixels is not None and pixels.ndim == 3


def _read_image(file: Path, size: tuple[int, int], colour: bool) -> tuple[np.ndarray | None, tuple[int, int]]:
    """Returns pixels ``[C, H, W]``, RGB or grey, and the file's own (H, W)."""
    pixels = _decode(file, cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE)
    return (None, (0, 0)) if pixels is None else (scaled(pixels, size), pixels.shape[:2])
