"""TorchRL data set of users' recordings."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.data.episodes import Episode, hashed_tests
from torch_denkf.data.options import ReplayOptions, check_options
from torch_denkf.data.pictures import JoinedPictures, check_size, float_pictures
from torch_denkf.data.recordings.frames import Frames
from torch_denkf.data.recordings.tables import Readings, Table
from torch_denkf.data.replay import EpisodeReplay
from torch_denkf.data.statistics import picture_statistics
from torch_denkf.data.times import Span, interpolate, last_reading, nearest_reading, row_times, rows_ago
from torch_denkf.diagnosis.logs import look_at_repeats

__all__ = ["Recording", "RecordingReplay"]

_LITTLE = 0.2  # share of readings; fewer in the common time hint at a wrong unit
_LOST = 0.02  # share of readings, or of time, that may be lost without a warning
_LONG = 1.0  # s of a recording that may be lost without a warning, at most
_PICTURE = "_picture"  # temporary entry of the rows: the index of each row's image
_TAKEN = (
    "episode",
    "step",
    "time",
    "pixels",
    "observed",
    "is_init",
    "next",
    "done",
    "terminated",
    "truncated",
    "index",
    "reward",
    "recorded",
    "belief",
)


class Recording:
    """One episode: a camera and other streams, each with its own sampling times on a common clock.

    Args:
        name: name of the episode; by default that of the first stream's file.
        **streams: streams by their names in the data set. One may be images, a :class:`~torch_denkf.data.Video` or
            :class:`~torch_denkf.data.Images`; the others are :class:`~torch_denkf.data.Table`. ``state`` is the ground
            truth, ``action`` the command; other names are free.

    Raises:
        TypeError: for streams that are neither images nor tables.
        ValueError: without streams, with two cameras, or with reserved names.

    Examples:
        >>> from torch_denkf.data import Table, Video
        >>> run = Recording(
        ...     camera=Video("run1.mp4"), state=Table("run1.csv", time="t", columns=["x", "y"], sample="linear")
        ... )
        >>> run.name, list(run.streams)
        ('run1', ['camera', 'state'])
    """

    def __init__(self, *, name: str | None = None, **streams: Frames | Table):
        if not (name is None or isinstance(name, str)):
            raise TypeError(f"name is that of the recording, got {type(name).__name__}; give the stream another name")
        if not streams:
            raise ValueError("a recording needs streams, such as camera=Video('run1.mp4'), state=Table('run1.csv')")
        for key, stream in streams.items():
            if not isinstance(stream, (Frames, Table)):
                raise TypeError(f"stream {key!r} is a Video, Images or Table, got {type(stream).__name__}")
            taken = key in _TAKEN or key.startswith("_")
            late = key.endswith("_late") and _comes_late(streams.get(key.removesuffix("_late")))
            if late or key.endswith("_observed") or (taken and not isinstance(stream, Frames)):
                raise ValueError(
                    f"the data set, or an environment or a filter that reads it, has an entry {key!r} of its own; give "
                    "the stream another name"
                )
        cameras = [key for key, stream in streams.items() if isinstance(stream, Frames)]
        if len(cameras) > 1:
            raise ValueError(f"a recording has one camera, got {cameras}; make a data set for each")
        self.camera = cameras[0] if cameras else None
        self.streams = dict(streams)
        self.name = Path(next(iter(streams.values())).file).stem if name is None else name


@dataclass(frozen=True)
class RecordingEpisode(Episode):
    """One recording.

    Attributes:
        begin: time of the first row, in s, on the recording's clock.
    """

    begin: float


class RecordingReplay(EpisodeReplay):
    r"""Replay buffer of users' recordings, resampled to rows on one clock.

    Keys, samples and splits are those of :class:`~torch_denkf.data.EpisodeReplay`; here the readings are

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``pixels``            [n,3,H,W]    float32 in [0, 1], RGB, of the camera, independent of its stream's name
    ``observed``          [n,1]        bool: the row has a new image; other rows' pixels are zero. Only with a camera
    NAME                  [n,C]        float32: the columns of the table ``NAME``, such as ``state``; zero if missing
    ``NAME_observed``     [n,1]        bool: the row has a new reading
    ``NAME_late``         [n,1]        int64, for tables with ``arrived``: latency of the reading in rows
    ===================== ============ ===========================================================================

    Rows are the times of the stream ``clock``, or of a rate, from where all streams have begun to where the first one
    ends: ``episodes[k].begin`` is the time of the first. A pose from an earlier time is therefore not the pose of the
    first row, unless ``span="all"`` keeps the rows before it. The other streams are resampled to these rows by their
    ``sample``:

    * ``"last"``, the default, is a zero-order hold of the last value. It is causal, and delays readings by up to one
      row.
    * ``"nearest"`` uses readings up to half a row ahead. Use it for smoothing: a delay of part of a row is a bias.
    * ``"linear"`` uses the next reading, too. It suits a ``state`` that is known afterwards.

    A reading is *observed* in one row: with ``"last"`` the first row after it arrived, with ``"nearest"`` its nearest.
    A filter with ``observed_key="imu_observed"`` then uses each reading once, and a model that reads the held value,
    such as an ``action``, finds it in all rows. ``"observed"``, the filters' default, is the camera's mask. With
    ``"linear"`` every value counts as observed. Delayed readings, of a :class:`~torch_denkf.data.Table` with
    ``arrived``, are observed in the first row after they arrived.

    Images are decoded once, scaled to ``size`` and memory-mapped. Tables are read again each time.

    Args:
        recordings: one, or several with the same streams; each is an episode.
        clock: name of the stream whose times become the rows' times, or a rate in Hz; by default the camera, or else
            the first stream.
        span: ``"common"``: rows from where all streams have begun to where the first one ends; a warning says how much
            is left out. ``"all"``: all times of the ``clock``; a rate runs from the first begin to the last end of a
            stream. A stream is zero and not observed before it begins, and not observed after its end.
        size: (H, W) to scale the images to, ignoring their aspect ratio.
        test_share: share of the recordings in the test split, by a hash of their names; none by default.
        **options: of :class:`~torch_denkf.data.EpisodeReplay`.

    Attributes:
        episodes: episodes with the recordings' names, and their ``begin`` on the recording's clock.
        columns: names of the columns of each table.

    Raises:
        FileNotFoundError: without a stream's file or folder.
        ImportError: for Parquet files, without pyarrow.
        ValueError: for an unknown ``span``; tables that lack columns, have invalid numbers, or whose times do not
            ascend; images that cannot be decoded; streams without common times; recordings that differ in their streams
            or share a name.
        OSError: if the cache cannot be written.

    Examples:
        >>> from tempfile import mkdtemp
        >>> from torch_denkf.data import Table
        >>> file = Path(mkdtemp()) / "run1.csv"
        >>> _ = file.write_text("t,x,wheel\n" + "".join(f"{k / 10},{k},{2 * k}\n" for k in range(20)))
        >>> run = Recording(state=Table(file, ["x"], time="t"), wheel=Table(file, ["wheel"], time="t"))
        >>> data = RecordingReplay(run, clock=5.0, num_slices=2, slice_len=4)
        >>> data.sample()["wheel"].shape, data[:3]["state"].flatten(), data[:3]["time"].flatten()
        (torch.Size([2, 4, 1]), tensor([0., 2., 4.]), tensor([0.0000, 0.2000, 0.4000], dtype=torch.float64))
    """

    episodes: tuple[RecordingEpisode, ...]

    def __init__(
        self,
        recordings: Recording | Sequence[Recording],
        *,
        clock: str | float | None = None,
        span: Span = "common",
        size: tuple[int, int] = (96, 128),
        test_share: float = 0.0,
        **options: Unpack[ReplayOptions],
    ):
        check_options(options)
        for_tests = hashed_tests(test_share)
        recordings = [recordings] if isinstance(recordings, Recording) else list(recordings)
        size = check_size(size)
        clock = _check(recordings, clock)
        if span not in ("common", "all"):
            raise ValueError(f"span is 'common' or 'all', got {span!r}")
        cache, progress = options.get("cache", True), options.get("progress", True)
        rows: list[TensorDict] = []
        episodes: list[RecordingEpisode] = []
        pictures: list[Tensor] = []
        self.columns: dict[str, tuple[str, ...]] = {}
        for recording in recordings:
            streams: dict[str, Any] = {
                key: stream.read() if isinstance(stream, Table) else stream.read(size, cache, progress)
                for key, stream in recording.streams.items()
            }
            self._check_columns(recording, streams)
            part, begin = _on_clock(recording, streams, clock, span)
            if recording.camera is not None:
                frame = part[_PICTURE]
                part[_PICTURE] = torch.where(frame >= 0, frame + sum(map(len, pictures)), -1)
                pictures.append(streams[recording.camera]["pixels"])
            episodes.append(RecordingEpisode(recording.name, sum(map(len, rows)), len(part), begin))
            rows.append(part)
        together: TensorDict = torch.cat(rows)
        self._numbers = tuple(self.columns)
        self._picture, self._pictures = together.pop(_PICTURE, None), JoinedPictures(pictures)
        super().__init__(
            together,
            episodes,
            for_tests=for_tests,
            pictures=None if self._picture is None else partial(_pixels, self._pictures, self._picture),
            **options,
        )

    def _check_columns(self, recording: Recording, streams: Mapping[str, Any]) -> None:
        columns = {key: stream.columns for key, stream in streams.items() if isinstance(stream, Readings)}
        for key, names in columns.items():
            if self.columns.setdefault(key, names) != names:
                raise ValueError(
                    f"recording {recording.name!r} has {list(names)} in {key!r}, the first one has "
                    f"{list(self.columns[key])}; pass columns= to all of them"
                )

    def _picture_statistics(self, index: Tensor) -> dict[str, Tensor] | None:
        if self._picture is None:
            return None
        frame = self._picture[index]
        return picture_statistics(self._pictures, frame[frame >= 0])


def _pixels(pictures: JoinedPictures, picture: Tensor, row: Tensor) -> dict[str, Tensor]:
    return float_pictures(pictures, picture[row])


def _check(recordings: Sequence[Recording], clock: str | float | None) -> str | float:
    """Checks that the recordings have the same streams, and returns their clock.

    Raises:
        ValueError: if their streams differ, or the clock is none of them.
    """
    if not recordings:
        raise ValueError("there are no recordings; pass one, or a list of them")
    strange = [type(recording).__name__ for recording in recordings if not isinstance(recording, Recording)]
    if strange:
        raise TypeError(f"RecordingReplay reads a Recording, or a list of them; got {strange[0]}")
    first, names = recordings[0], [recording.name for recording in recordings]
    if len(set(names)) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(
            f"recordings are told apart by their names, but {twice} are there twice; pass Recording(name=)"
        )
    for recording in recordings:
        if set(recording.streams) != set(first.streams) or recording.camera != first.camera:
            raise ValueError(
                f"recording {recording.name!r} has the streams {list(recording.streams)}, {first.name!r} has "
                f"{list(first.streams)}; recordings of one data set have the same"
            )
        for key, stream in recording.streams.items():
            if _comes_late(stream) != _comes_late(first.streams[key]):
                raise ValueError(
                    f"the table {key!r} has arrived= in one of the recordings {recording.name!r} and {first.name!r}; "
                    "recordings of one data set have the same"
                )
    if clock is None:
        return first.camera or next(iter(first.streams))
    if isinstance(clock, str) and clock not in first.streams:
        raise ValueError(f"clock is a stream, one of {list(first.streams)}, or a rate in Hz; got {clock!r}")
    if not isinstance(clock, str) and not 0 < clock < np.inf:
        raise ValueError(f"clock is a stream or a positive rate in Hz, got {clock}")
    return clock


def _warn_of_lost_readings(recording: str, key: str, times: np.ndarray, rows: np.ndarray, seen: np.ndarray) -> None:
    """Warns if few readings are in the common time, or if readings are lost because they share a row."""
    inside = int(((times >= rows[0]) & (times <= rows[-1])).sum())
    if inside < _LITTLE * len(times):
        warnings.warn(
            f"recording {recording!r}: {inside} of {len(times)} readings of {key!r}, {times[0]:g} to {times[-1]:g} s, "
            f"lie in the time that all streams share, {rows[0]:g} to {rows[-1]:g} s; if its times are not in s, pass "
            "unit='ms', 'us' or 'ns'",
            stacklevel=5,
        )
    lost = inside - int(seen.sum())
    if inside <= len(rows) and lost > _LOST * inside:
        warnings.warn(
            f"recording {recording!r}: {lost} of {inside} readings of {key!r} share a row with another and are not "
            f"used, because their times do not fit the clock; pass sample='nearest', or clock={key!r}",
            stacklevel=5,
        )


def _warn_of_lost_rows(recording: str, times: Mapping[str, np.ndarray], clock: str | float, rows: np.ndarray) -> None:
    """Warns if the clock begins before, or ends after, some other stream."""
    own = [times[clock]] if isinstance(clock, str) else list(times.values())
    begin, end = rows[0] - min(of[0] for of in own), max(of[-1] for of in own) - rows[-1]
    step = float(np.median(np.diff(rows)))
    if max(begin, end) > step + min(_LONG, _LOST * (rows[-1] - rows[0])):
        late, early = max(times, key=lambda key: times[key][0]), min(times, key=lambda key: times[key][-1])
        warnings.warn(
            f"recording {recording!r}: {begin:.3g} s before its first row and {end:.3g} s after its last one are left "
            f"out, because {late!r} begins at {times[late][0]:.10g} s and {early!r} ends at {times[early][-1]:.10g} s; "
            f"what is known of the beginning, such as a pose, is not that of the first row, {rows[0]:.10g} s. Pass "
            "span='all' to keep them: a stream is not observed before it begins",
            stacklevel=5,
        )


def _on_clock(
    recording: Recording, streams: Mapping[str, Any], clock: str | float, span: Span
) -> tuple[TensorDict, float]:
    """Returns rows of a recording, with the index of each row's image, and the time of the first, s."""
    taken = {
        key: stream.times if isinstance(stream, Readings) else stream["time"].numpy() for key, stream in streams.items()
    }
    came: dict[str, Any] = {}
    times: dict[str, np.ndarray] = {}
    for key, stream in streams.items():
        came[key] = stream.arrived if _comes_late(stream) else taken[key]
        until = None if key == clock else getattr(stream, "until", None)
        times[key] = np.unique(came[key] if until is None else np.append(came[key], until))
    try:
        rows = row_times(times, clock, span)
    except ValueError as error:
        raise ValueError(f"recording {recording.name!r}: {error}") from error
    if span == "common":
        _warn_of_lost_rows(recording.name, times, clock, rows)
    out: dict[str, Tensor] = {}
    for key, stream in recording.streams.items():
        read = streams[key]
        if isinstance(stream, Table) and stream.repeats is None and key != "action":  # commands are held
            look_at_repeats(read.values, read.columns, stream.file)
        if stream.sample == "linear":
            values, seen = interpolate(taken[key], read.values, rows, stream.tolerance)
        else:
            if stream.sample == "nearest":
                index, seen = nearest_reading(taken[key], rows, stream.tolerance)
            else:
                order = np.argsort(came[key], kind="stable")  # a reading may overtake others
                index, seen = last_reading(came[key][order], rows, stream.tolerance, taken[key][order])
                index = np.where(index >= 0, order[index], -1)
            _warn_of_lost_readings(recording.name, key, np.sort(came[key]), rows, seen)
            if not isinstance(read, Readings):
                out[_PICTURE] = torch.from_numpy(np.where(seen, index, -1))
                out["observed"] = torch.from_numpy(seen[:, None])
                continue
            values = np.where((index >= 0)[:, None], read.values[index], 0.0)
            if _comes_late(read):
                late = np.where(index >= 0, rows_ago(taken[key][index], rows), 0)
                out[f"{key}_late"] = torch.from_numpy(late[:, None])
        out[key] = torch.from_numpy(values.astype(np.float32))
        out[f"{key}_observed"] = torch.from_numpy(seen[:, None])
    out["step"] = torch.arange(len(rows)).unsqueeze(-1)
    out["time"] = torch.from_numpy(rows[:, None] - rows[0])
    return TensorDict(out, [len(rows)]), float(rows[0])


def _comes_late(stream: Any) -> bool:
    return getattr(stream, "arrived", None) is not None
