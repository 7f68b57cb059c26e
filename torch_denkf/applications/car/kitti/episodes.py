"""Finds and reads the episodes of a KITTI data set: one for each drive and camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tensordict import TensorDict, TensorDictBase

from torch_denkf.applications.car.kitti.drive import _frame_files, list_kitti_drives, read_kitti_drive
from torch_denkf.applications.car.kitti.motion import with_motion
from torch_denkf.data.episodes import Episode
from torch_denkf.deployment.progress import progress_bar

PAIRS = (("image_2", "image_3"), ("image_0", "image_1"))


@dataclass(frozen=True)
class KITTIEpisode(Episode):
    """Drive of one camera, or its mirror image.

    Attributes:
        drive: name of the sequence.
        camera: folder of the images.
        mirrored: whether left and right are swapped.
    """

    drive: str
    camera: str
    mirrored: bool

    @property
    def split_name(self) -> str:
        """Returns the drive: its cameras and mirror images are in the same split."""
        return self.drive


def find_drives(root: Path, drives: Sequence[str | int] | str | int | None) -> list[str]:
    """Returns the names of the drives to read, in the requested order; by default all with images and poses.

    Raises:
        FileNotFoundError: if there is none; the message lists the missing files.
        ValueError: if the list of drives is empty or has duplicates.
    """
    found = list_kitti_drives(root)
    if drives is None:
        if not found:
            raise FileNotFoundError(f"no drive below {root} has both images and poses: {_what_is_there(root)}")
        return found
    asked = [drives] if isinstance(drives, (str, int)) else drives
    names = [f"{name:02d}" if isinstance(name, int) else name for name in asked]
    if not names or len(set(names)) < len(names):
        raise ValueError(f"drives are names, each once, or None for all; got {names}")
    return names


def _what_is_there(root: Path) -> str:
    folders = sorted(entry.name for entry in (root / "sequences").iterdir() if entry.is_dir())
    poses = sorted(file.stem for file in (root / "poses").glob("*.txt"))
    if not folders and not poses:
        return "it is empty; download KITTI's odometry benchmark, or render drives (`denkf render-kitti`)"
    without = [name for name in folders if name not in poses]
    others = sorted({*folders, *poses} - set(without))
    return "; ".join(
        text
        for text in (
            f"no {', '.join(f'poses/{name}.txt' for name in without)}" if without else "",
            f"no images sequences/NAME/image_*/FFFFFF.png for {others}" if others else "",
        )
        if text
    )


def find_cameras(root: Path, drive: str, cameras: str | Sequence[str]) -> list[str | None]:
    """Returns the cameras of one drive to read; None stands for the first that has images.

    Raises:
        ValueError: if ``cameras`` is neither ``"first"``, ``"both"`` nor a sequence of folder names.
    """
    if cameras == "both":
        for pair in PAIRS:
            there: list[str | None] = [camera for camera in pair if _frame_files(root / "sequences" / drive / camera)]
            if there:
                return there
        return [None]  # the reader raises for missing images
    if cameras == "first":
        return [None]
    if isinstance(cameras, str) or not cameras or len(set(cameras)) < len(cameras):
        raise ValueError(
            f"cameras is 'first', 'both' or a sequence of folder names, such as ['image_2'], each once; got {cameras!r}"
        )
    return list(cameras)


def read_drives(
    root: Path,
    sources: Sequence[tuple[str, str]],
    *,
    size: tuple[int, int],
    colour: bool | None,
    cache: str | Path | bool | None,
    flow: bool | Callable[[TensorDictBase], TensorDictBase],
    progress: bool,
) -> list[TensorDict]:
    """Reads drives, and adds optical flow if requested: True stands for :func:`with_motion` with the same cache.

    Raises:
        ValueError: if ``flow`` does not return the drive with ``"flow"``, or if drives differ in the entries of a
            frame.
    """
    counts = [len(_frame_files(root / "sequences" / drive / camera)) for drive, camera in sources]
    if not isinstance(flow, bool) and not callable(flow):
        raise TypeError(f"flow is True, False, or what adds 'flow' to a drive; got {flow!r}")
    add_flow = partial(with_motion, cache=cache) if flow is True else flow
    steps = 2 if add_flow else 1
    drives, ends = [], 0
    with progress_bar("reading drives", steps * sum(counts), unit=" images", shown=progress) as bar:
        for (name, camera), count in zip(sources, counts, strict=True):
            drive = read_kitti_drive(
                root, name, camera=camera, size=size, colour=colour, cache=cache, progress=bar.update
            )
            bar.update(ends + count - bar.n)  # images from the cache
            if add_flow:
                rows = drive.batch_size
                drive = add_flow(drive)
                if "flow" not in drive or drive.batch_size != rows:
                    raise ValueError(
                        f"flow must return the drive with 'flow', {rows[0]} rows of it; for {name}/{camera} it "
                        f"returned {sorted(drive.keys())} of batch size {tuple(drive.batch_size)}"
                    )
                bar.update(count)
            ends += steps * count
            drives.append(drive)
    shapes = [_shapes(drive) for drive in drives]
    for source, shape in zip(sources, shapes, strict=True):
        if shape != shapes[0]:
            raise ValueError(
                f"{'/'.join(source)} has frames of {shape}, but {'/'.join(sources[0])} has {shapes[0]}; "
                "pass colour=True or colour=False, and a flow that is the same for all"
            )
    return drives


def _shapes(drive: TensorDictBase) -> dict[str, tuple[int, ...]]:
    return {key: tuple(drive[key].shape[1:]) for key in ("image", "flow", "road") if key in drive}
