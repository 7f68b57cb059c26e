"""Frames of a video by their presentation times."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from torch_denkf.deployment.files import name_for_c

EXTRA = "pip install 'torch_denkf[lerobot]'"
NOT_DECODED = (
    "no frame of {} can be decoded: it is damaged (download or copy it again), or in a codec that OpenCV here lacks, "
    f"such as AV1 ({EXTRA} brings PyAV, which has it)"
)


def frames_at_times(file: Path, times: np.ndarray, tolerance: float) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Decodes a video once and assigns its frames to the given times.

    Frames are assigned by time, not by count: decoders skip damaged frames silently, which would shift later ones.

    Args:
        file: the video.
        times: s after the video's first frame, ``[n]``, in any order.
        tolerance: largest difference in time, s.

    Yields:
        Indices into ``times``, and their frame, RGB uint8 ``[H, W, 3]``. An index is yielded again if a later frame is
        nearer; an index without a frame within the tolerance is not yielded.

    Raises:
        FileNotFoundError: without the file.
        ValueError: if no frame of the file can be decoded.
    """
    if not file.is_file():
        raise FileNotFoundError(f"no video {file}; download or copy it completely, or pass another camera")
    order = np.argsort(times, kind="stable")
    ordered, off = times[order], np.full(len(times), np.inf)
    any_decoded = False
    for time, frame in decoded_frames(file):
        any_decoded = True
        if time > ordered[-1] + tolerance:
            break
        first, last = np.searchsorted(ordered, [time - tolerance, time + tolerance])
        near = order[first:last]
        near = near[np.abs(times[near] - time) < off[near]]
        if len(near):
            off[near] = np.abs(times[near] - time)
            yield near, frame
    if not any_decoded:
        raise ValueError(NOT_DECODED.format(file))


def decoded_frames(file: Path) -> Iterator[tuple[float, np.ndarray]]:
    """Yields all frames that can be decoded, in the order of presentation."""
    capture = cv2.VideoCapture(name_for_c(file), cv2.CAP_FFMPEG)
    try:
        # OpenCV's wheels decode AV1, LeRobot's default, only in hardware.
        if _codec(capture) == "av01":
            try:
                import av
            except ImportError:
                pass
            else:
                yield from _by_pyav(av, file)
                return
        yield from _by_opencv(capture)
    finally:
        capture.release()


def say_if_cut(file: Path, times: Sequence[float]) -> None:
    """Warns if a video is shorter than its header announces.

    Args:
        file: the video.
        times: times of the decoded frames, s, at least one.
    """
    capture = cv2.VideoCapture(name_for_c(file), cv2.CAP_FFMPEG)
    count, rate = (capture.get(what) for what in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
    capture.release()
    if count <= 0 or rate <= 0:
        return
    # The last frame lasts one step; without a count in the header, OpenCV estimates it from the duration.
    step = max(np.diff(times).max(initial=0), 1 / rate)
    shown = times[-1] - times[0] + 1 / rate
    if count / rate > shown + 0.6 * step:
        warnings.warn(
            f"{file} shows {shown:.4g} s, but announces {count / rate:.4g} s: is it cut? Copy it again, or go on "
            "without its end",
            stacklevel=2,
        )


def _codec(capture: cv2.VideoCapture) -> str:
    return int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True).decode("latin1").lower()


def _by_opencv(capture: cv2.VideoCapture) -> Iterator[tuple[float, np.ndarray]]:
    # A failed read is the end, or a damaged frame, after which reading continues. The announced count is too low for
    # varying rates, so that the end is the first failure after it.
    expected, read, there = capture.get(cv2.CAP_PROP_FRAME_COUNT), 0, True
    while there or read < expected:
        there, frame = capture.read()
        read += 1
        if there:
            yield capture.get(cv2.CAP_PROP_POS_MSEC) / 1000, frame[..., ::-1]


def _by_pyav(av, file: Path) -> Iterator[tuple[float, np.ndarray]]:
    try:
        container = av.open(str(file))
    except av.FFmpegError:
        return
    with container:
        stream = container.streams.video[0]
        start = float((stream.start_time or 0) * stream.time_base)
        for packet in container.demux(stream):
            try:
                for frame in packet.decode():
                    yield frame.time - start, frame.to_ndarray(format="rgb24")
            except av.FFmpegError:  # a damaged packet: the next ones may be whole
                continue
