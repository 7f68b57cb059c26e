"""Reads users' images from a folder or a video, the camera's calibration, and the frames' times."""

from __future__ import annotations

import json
import math
import re
import warnings
from collections.abc import Iterator
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np

from torch_denkf.applications.car.kitti.files import read_calibration
from torch_denkf.data.pictures import is_bomb, picture_files
from torch_denkf.data.text import read_number
from torch_denkf.deployment.files import name_for_c

__all__ = ["FrameSource", "read_camera", "read_frames", "read_times"]

_IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".webp"}
_NAMES = ("fx", "fy", "cx", "cy")
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def read_camera(file: str | Path, camera: str | None = None) -> tuple[float, float, float, float]:
    r"""Reads focal lengths and principal point.

    The file is KITTI's ``calib.txt`` with rows ``P0:`` to ``P3:``; or has ``fx``, ``fy``, ``cx`` and ``cy`` in JSON,
    YAML or text (``fx: 718.9`` or ``fx = 718.9``); or four numbers in this order.

    Args:
        file: the file.
        camera: camera of a ``calib.txt``, ``image_0`` to ``image_3``; needed if its rows differ.

    Returns:
        (fx, fy, cx, cy) in pixels.

    Raises:
        FileNotFoundError: without the file.
        ValueError: if a number is missing; the message names it and the file.

    Example:
        >>> import tempfile
        >>> file = Path(tempfile.mkdtemp()) / "camera.yaml"
        >>> _ = file.write_text("fx: 718.9\nfy: 718.9  # the same\ncx: 607.2\ncy: 185.2\n")
        >>> read_camera(file)
        (718.9, 718.9, 607.2, 185.2)
    """
    file = Path(file).expanduser()
    if not file.is_file():
        raise FileNotFoundError(f"no calibration {file}; it has rows 'P0: ...' as KITTI's calib.txt, or fx, fy, cx, cy")
    text = file.read_text(errors="replace")
    if re.search(r"^P[0-3]:", text, re.MULTILINE):
        return _of_kitti(file, text, camera)
    if text.lstrip().startswith("{"):
        try:
            content = json.loads(text)
        except ValueError as error:
            raise ValueError(f"{file} is not JSON: {error}") from error
        found = {name: content[name] for name in _NAMES if name in content}
    else:
        plain = re.sub(r"#.*", "", text)
        found = dict(re.findall(rf"\b({'|'.join(_NAMES)})\b[\"']?\s*[:=]?\s*({_NUMBER})", plain))
        words = plain.replace(",", " ").split()
        if not found and len(words) == 4:
            found = dict(zip(_NAMES, words, strict=True))
    if missing := [name for name in _NAMES if name not in found]:
        raise ValueError(f"{file} does not say {', '.join(missing)}; write a line 'fx: 718.9' for each, in pixels")
    try:
        fx, fy, cx, cy = (read_number(str(found[name])) for name in _NAMES)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{file}: fx, fy, cx and cy must be numbers ({error})") from error
    if not all(map(math.isfinite, (fx, fy, cx, cy))) or min(fx, fy) <= 0:
        raise ValueError(f"{file}: fx and fy must be positive and all finite; got {fx}, {fy}, {cx}, {cy}")
    return fx, fy, cx, cy


def _of_kitti(file: Path, text: str, camera: str | None) -> tuple[float, float, float, float]:
    names = [f"image_{row}" for row in re.findall(r"^P([0-3]):", text, re.MULTILINE)]
    if camera is not None:
        names = [camera]
    found = {tuple(float(value) for value in read_calibration(file, name)) for name in names}
    if len(found) > 1:
        raise ValueError(f"{file} has several cameras, {', '.join(names)}, that differ; say which took the images")
    fx, fy, cx, cy = found.pop()
    return fx, fy, cx, cy


def read_times(file: str | Path) -> list[float]:
    """Reads the times of frames: the first number of each row, in s; ``#`` begins a comment.

    Raises:
        FileNotFoundError: without the file.
        ValueError: if a row does not begin with a number; the message names file and line.
    """
    file = Path(file).expanduser()
    if not file.is_file():
        raise FileNotFoundError(f"no times {file}; a row for each frame, in s")
    times = []
    for number, line in enumerate(file.read_text(errors="replace").splitlines(), start=1):
        words = re.split(r"[\s,;]+", line.split("#")[0].strip())
        if words == [""]:
            continue
        try:
            times.append(read_number(words[0]))
        except ValueError as error:
            raise ValueError(f"{file}:{number}: expected a time in s, got {line.strip()[:40]!r}") from error
    return times


class FrameSource:
    """Iterable over the frames of a folder or a video; see :func:`read_frames`.

    Attributes:
        first: number of the first frame: from its name in a folder of numbered images, else 0.
        count: number of frames, including missing ones; ``None`` if a video does not tell.
        fps: frames per second of a video; ``None`` if unknown.
    """

    def __init__(self, path: Path, files: list[Path | None] | None, first: int, count: int | None, fps: float | None):
        self.path, self._files, self.first, self.count, self.fps = path, files, first, count, fps

    def __iter__(self) -> Iterator[np.ndarray | None]:
        if self._files is None:
            yield from (image for _, image in self._video())
            return
        for file in self._files:
            data = np.zeros(0, np.uint8) if file is None else np.fromfile(file, np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_ANYCOLOR) if len(data) and not is_bomb(data.tobytes()) else None
            if file is not None and image is None:
                warnings.warn(f"{file} cannot be read as an image; its frame counts as missing", stacklevel=2)
            yield image

    def stamps(self) -> list[float] | None:
        """Reads the time stamps of a video's frames.

        This decodes all frames: 0.7 ms per frame of 1280 x 720 pixels.

        Returns:
            A time in s for each frame, relative to the first, interpolated for missing frames. ``None`` for a folder,
            or if the times do not increase.
        """
        if self._files is not None:
            return None
        stamps = np.array([math.nan if time is None else time for time, _ in self._video(pictures=False)])
        there = np.isfinite(stamps)
        if there.sum() < 2 or not (np.diff(stamps[there]) > 0).all():
            return None
        numbers = np.arange(len(stamps))
        return (np.interp(numbers, numbers[there], stamps[there]) - stamps[there][0]).tolist()

    def _video(self, pictures: bool = True) -> Iterator[tuple[float | None, np.ndarray | None]]:
        """Yields times in s and, if requested, images; ``None`` for missing frames."""
        video = cv2.VideoCapture(name_for_c(self.path))
        try:
            # A failed read is a damaged frame or the end, which may come before or after the announced count.
            expected, read, missing, there = video.get(cv2.CAP_PROP_FRAME_COUNT), 0, 0, True
            while there or read < expected:
                there, image = video.read() if pictures else (video.grab(), None)
                read += 1
                missing += not there
                if there:
                    yield from repeat((None, None), missing)
                    yield video.get(cv2.CAP_PROP_POS_MSEC) / 1000, image
                    missing = 0
            ended = read - missing
            if pictures and ended < expected:
                warnings.warn(
                    f"{self.path} says that it has {expected:.0f} frames; only the first {ended} can be read. The path "
                    f"ends there, and leaves {expected - ended:.0f} out. Is the file cut?",
                    stacklevel=2,
                )
        finally:
            video.release()


def read_frames(path: str | Path) -> FrameSource:
    """Opens a folder of images, in the order of their names, or a video.

    Names are sorted naturally: ``frame10`` comes after ``frame9``. If all names are numbers, as KITTI's ``000018.png``,
    gaps are missing frames. In a video, frames that cannot be read are missing; at its end they are left out, and a
    warning counts them.

    Args:
        path: folder of png, jpg, bmp, tif, pgm, ppm or webp files; or a video file.

    Returns:
        The frames: grey ``[H, W]`` or colour ``[H, W, 3]`` in OpenCV's order, uint8; ``None`` for a missing one.

    Raises:
        FileNotFoundError: if there is nothing at ``path``, or no image in the folder.
        ValueError: if the file is no video that OpenCV decodes, its name is no UTF-8, two images have the same frame
            number, or an image is no file, but a pipe.

    Example:
        >>> import tempfile
        >>> folder = Path(tempfile.mkdtemp())
        >>> for name in ("000007.png", "000009.png"):
        ...     _ = cv2.imwrite(str(folder / name), np.zeros((4, 6), np.uint8))
        >>> frames = read_frames(folder)
        >>> frames.first, [frame is None for frame in frames]
        (7, [False, True, False])
    """
    path = Path(path).expanduser()
    if path.is_dir():
        files = sorted(picture_files(path, _IMAGES), key=lambda f: _natural(f.name))
        if not files:
            raise FileNotFoundError(f"no images in {path}; expected png, jpg, bmp, tif, pgm, ppm or webp files")
        numbers = [int(file.stem) if file.stem.isdigit() else -1 for file in files]
        span = numbers[-1] - numbers[0] + 1
        if min(numbers) >= 0 and len(set(numbers)) < len(numbers):
            twice = [file.name for file, number in zip(files, numbers, strict=True) if numbers.count(number) > 1]
            raise ValueError(f"{path} has two images of one number, {', '.join(twice[:2])}; take one out of the folder")
        if min(numbers) < 0 or span > 2 * len(numbers) + 10:
            return FrameSource(path, list(files), 0, len(files), None)
        of = dict(zip(numbers, files, strict=True))
        return FrameSource(path, [of.get(n) for n in range(numbers[0], numbers[-1] + 1)], numbers[0], span, None)
    if not path.is_file():
        raise FileNotFoundError(f"nothing at {path}; pass a folder of images or a video")
    video = cv2.VideoCapture(name_for_c(path))
    there, _ = video.read()
    fps, count = video.get(cv2.CAP_PROP_FPS), int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    if not there:
        raise ValueError(
            f"{path} is no video that OpenCV decodes; convert it, for example: ffmpeg -i {path.name} -c:v libx264 "
            "out.mp4, or extract its frames to a folder"
        )
    return FrameSource(path, None, 0, count if count > 0 else None, fps if 0 < fps < 1000 else None)


def _natural(name: str) -> list[tuple[int, int, str]]:
    parts = re.split(r"(\d+)", name)
    return [(0, int(part), "") if part.isdigit() else (1, 0, part) for part in parts if part]
