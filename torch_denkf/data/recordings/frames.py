"""Camera images over time: a video, or a folder of images, decoded once."""

from __future__ import annotations

import hashlib
import json
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf._checks import check_number
from torch_denkf.data.cache import cache_folder, cached, stamp
from torch_denkf.data.pictures import CURE, decode_picture, picture_files, scaled, text_of_size, unnamed_file
from torch_denkf.data.recordings.tables import check_stream, check_times, given_times
from torch_denkf.data.text import read_number
from torch_denkf.data.video import NOT_DECODED, decoded_frames, say_if_cut
from torch_denkf.deployment.files import clear_errors
from torch_denkf.deployment.progress import progress_bar
from torch_denkf.diagnosis.logs import SECONDS, Unit, look_at_times

__all__ = ["Frames", "Images", "Video"]

_FORMAT = 2  # part of the cache's key: raise it when the stored content changes
_SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".webp", ".tif", ".tiff")


@dataclass(frozen=True)
class Frames:
    """Base class of a camera's images; use :class:`Video` or :class:`Images`.

    Args:
        file: the video, or the folder of images.
        times: times at which the images were taken: a CSV or Parquet file with one row per image, or an array. By
            default the times in the video, or the numbers in the images' names.
        time: name of the column with times in that file.
        unit: of these times: ``"s"``, ``"ms"``, ``"us"`` or ``"ns"``.
        start: offset in s, added to all times, such as the start of a video on the clock of the other streams.
        sample: image for a row of the data set: ``"last"``, the last one up to the row's time, delayed by up to one
            row; or ``"nearest"``, the nearest in time, which may be in the future, for smoothing. Each image appears in
            one row only; rows without an image are not ``observed``.
        tolerance: in s; images that are farther away in time count as missing. By default no limit with ``"last"``,
            half a row's time with ``"nearest"``.

    Raises:
        ValueError: for an unknown ``unit`` or ``sample``, tolerances that are not positive, and a ``start`` that is not
            finite.
    """

    file: str | Path
    times: str | Path | Sequence[float] | None = None
    time: str = "time"
    unit: Unit = "s"
    start: float = 0.0
    sample: Literal["last", "nearest"] = "last"
    tolerance: float | None = None

    def __post_init__(self):
        check_stream(self.sample, ("last", "nearest"), self.tolerance, self.unit)
        check_number("start", self.start, cure="It is a time in s")

    def read(self, size: tuple[int, int], cache: str | Path | bool | None, progress: bool) -> TensorDict:
        """Reads all images, batch size ``[F]``: ``pixels`` uint8 ``[F, 3, H, W]``, RGB, and ``time`` float64, s.

        They are decoded once, and memory-mapped from the cache afterwards.

        Raises:
            FileNotFoundError: without the file or folder.
            ValueError: if none can be decoded, their sizes differ, or their times differ in number or do not ascend.
            OSError: if the cache cannot be written.
        """
        source = Path(os.path.realpath(Path(self.file).expanduser()))  # also of a link to itself
        files = self._files(source)
        folder = cache_folder(cache)
        if folder is None:
            stored = self._decode(source, files, size, None, progress)
        else:
            key = json.dumps([_FORMAT, *size, [(str(file), *stamp(file)) for file in files]])
            entry = folder / f"frames-{source.stem}-{hashlib.sha256(key.encode()).hexdigest()[:16]}"
            stored = cached(entry, lambda: self._decode(source, files, size, folder, progress))
        times = self._times(source, stored)
        check_times(times, lambda row: f"picture {row} (from 0) of {source}", self.time)
        look_at_times(times, source, self.time, self.unit)
        return TensorDict({"pixels": stored["pixels"], "time": torch.from_numpy(times)}, stored.batch_size)

    def _files(self, source: Path) -> list[Path]:
        """Returns the files to decode, in order."""
        raise NotImplementedError

    def _pictures(self, files: list[Path]) -> Iterator[tuple[float, np.ndarray | None, str]]:
        """Yields time, RGB pixels (None if damaged), and the name for messages of each image."""
        raise NotImplementedError

    def _own_times(self, source: Path, stored: TensorDict) -> np.ndarray:
        """Returns the default times of the images, s."""
        return stored["time"].numpy().copy()

    def _times(self, source: Path, stored: TensorDict) -> np.ndarray:
        if self.times is None:
            return self._own_times(source, stored) + self.start
        # Damaged images are not stored: "place" is the index of each stored image in the list of times.
        kept, there = stored["place"].numpy(), int(stored["count"][0])
        times, place = given_times(self.times, self.time, str(source), there, "pictures")
        check_times(times * SECONDS[self.unit], place, self.time)
        return times[kept] * SECONDS[self.unit] + self.start

    def _decode(
        self, source: Path, files: list[Path], size: tuple[int, int], folder: Path | None, progress: bool
    ) -> TensorDict:
        store, times, places, native, count = _Store(size, folder), [], [], None, 0
        with progress_bar(f"reading {source.name}", None, unit=" frames", shown=progress) as bar:
            for place, (time, pixels, name) in enumerate(self._pictures(files)):
                count = place + 1
                if pixels is None:
                    warnings.warn(f"{name} cannot be decoded; it counts as missing", stacklevel=2)
                    continue
                native = native or (pixels.shape[:2], name)
                if pixels.shape[:2] != native[0]:
                    raise ValueError(
                        f"{name} is {text_of_size(pixels.shape)}, but {native[1]} is {text_of_size(native[0])}; one "
                        "camera has pictures of one size"
                    )
                store.add(scaled(pixels, size))
                times.append(time)
                places.append(place)
                bar.update()
        if not times:
            raise ValueError(NOT_DECODED.format(source))
        entries = {"pixels": store.pictures(len(times)), "time": torch.tensor(times, dtype=torch.float64)}
        entries |= {"place": torch.tensor(places), "count": torch.full((len(times),), count)}
        return TensorDict(entries, [len(times)])


@dataclass(frozen=True)
class Video(Frames):
    """A camera's video file; see :class:`Frames` for the arguments.

    OpenCV decodes most codecs; AV1 needs PyAV: ``pip install 'torch_denkf[lerobot]'``. Times are the presentation times
    of the frames, relative to the video's first frame.

    Examples:
        >>> Video("run1.mp4", start=12.5).sample
        'last'
    """

    def _files(self, source: Path) -> list[Path]:
        if not source.is_file():
            raise FileNotFoundError(f"no video {self.file}; check the path")
        return [source]

    def _pictures(self, files: list[Path]) -> Iterator[tuple[float, np.ndarray | None, str]]:
        times = []
        for number, (time, pixels) in enumerate(decoded_frames(files[0])):
            times.append(time)
            yield time, pixels, f"frame {number} of {files[0]}"
        if times:
            say_if_cut(files[0], times)


@dataclass(frozen=True)
class Images(Frames):
    """A folder of images of one camera, sorted by name; see :class:`Frames` for the arguments.

    Args:
        rate: images per second, from ``start`` on, instead of ``times``. A gap in the numbers of the images is a
            missing image; a warning counts them.

    Raises:
        ValueError: as :class:`Frames`, for a ``rate`` that is not positive, and for ``rate`` together with ``times``.

    Examples:
        >>> Images("run1/images", rate=10.0).sample
        'last'
    """

    rate: float | None = None

    def __post_init__(self):
        super().__post_init__()
        if self.rate is None:
            return
        if self.times is not None:
            raise ValueError("pass times or rate, not both")
        check_number("rate", self.rate, above=0, cure="It is the number of pictures a second")

    def _files(self, source: Path) -> list[Path]:
        if not source.is_dir():
            raise FileNotFoundError(f"no folder {self.file}; check the path")
        files = picture_files(source, _SUFFIXES)
        if not files:
            raise ValueError(f"no images in {source}; expected names that end in {', '.join(_SUFFIXES)}")
        return sorted(files, key=_in_order)

    def _pictures(self, files: list[Path]) -> Iterator[tuple[float, np.ndarray | None, str]]:
        for file in files:
            yield 0.0, decode_picture(file.read_bytes()), str(file)

    def _own_times(self, source: Path, stored: TensorDict) -> np.ndarray:
        place = stored["place"].numpy()
        if self.rate is not None:
            return _counted(source, self._files(source))[place] / self.rate
        times = [_number(file) for file in self._files(source)]
        if None in times:
            name = self._files(source)[times.index(None)].name
            raise ValueError(
                f"nothing says when the images in {source} were taken: their names, such as {name!r}, are no times; "
                "pass times= or rate="
            )
        return np.array(times)[place] * SECONDS[self.unit]


def _counted(source: Path, files: list[Path]) -> np.ndarray:
    """Returns the frame number of each image at a steady rate; gaps in numbered names are missing images."""
    numbers = np.array([_number(file) or float((re.findall(r"\d+", file.stem) or "0")[-1]) for file in files])
    steps = np.diff(numbers)
    least = steps.min(initial=np.inf)
    if least <= 0 or not np.allclose(steps / least, (steps / least).round(), rtol=0, atol=1e-6):
        return np.arange(len(files))  # the names are not equally spaced numbers
    counted = ((numbers - numbers[0]) / least).round()
    missing = int(counted[-1]) + 1 - len(files)
    if missing:
        first = files[int(np.flatnonzero(np.diff(counted) > 1)[0])].name
        warnings.warn(
            f"{source}: by their numbers {missing} images are missing, the first after {first}; the others keep their "
            "times",
            stacklevel=6,
        )
    return counted


def _number(file: Path) -> float | None:
    """Returns the number in a file's name; ``None`` if the name is no number."""
    try:
        return read_number(file.stem)
    except ValueError:
        return None


def _in_order(file: Path) -> tuple[list[float], str]:
    """Returns the sort key: the number, or the numbers in the name, so that img_9 comes before img_10."""
    number = _number(file)
    return [float(part) for part in re.findall(r"\d+", file.stem)] if number is None else [number], file.name


class _Store:
    """Growing store of images: in memory, or in a temporary file.

    Args:
        size: (H, W).
        folder: folder of the file; None for memory.
    """

    def __init__(self, size: tuple[int, int], folder: Path | None):
        self._size, self._memory = size, bytearray()
        self._file = None if folder is None else unnamed_file(folder)
        self._folder = folder or Path()

    def add(self, pixels: np.ndarray) -> None:
        """Appends an image ``[3, H, W]``."""
        data = np.ascontiguousarray(pixels).tobytes()
        if self._file is None:
            self._memory += data
        else:
            with clear_errors(self._folder / "pictures", CURE, name=f"pictures to {self._folder}"):
                self._file.write(data)

    def pictures(self, count: int) -> torch.Tensor:
        """Returns all images, uint8 ``[count, 3, H, W]``."""
        shape = (count, 3, *self._size)
        if self._file is None:
            return torch.frombuffer(self._memory, dtype=torch.uint8).reshape(shape)
        with clear_errors(self._folder / "pictures", CURE, name=f"pictures to {self._folder}"):
            self._file.flush()
        return torch.from_numpy(np.memmap(self._file, np.uint8, "r+", shape=shape))
