"""Images as arrays, and video files that are written frame by frame."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from torch import Tensor

_GIF_HEAD = b"GIF89a"
_GIF_FOREVER = b"\x21\xff\x0bNETSCAPE2.0\x03\x01\x00\x00\x00"


def as_picture(frame: Tensor | np.ndarray) -> np.ndarray:
    """Converts a frame ``[H, W]``, ``[H, W, C]`` or ``[C, H, W]``, uint8 or floats in [0, 1], to ``[H, W, 3]`` uint8.

    Raises:
        ValueError: for other shapes.
    """
    if isinstance(frame, Tensor):
        frame = frame.detach().cpu()
        frame = (frame.float() if frame.is_floating_point() else frame).numpy()
    array = np.asarray(frame)
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3:
        raise ValueError(f"a frame must be [H, W], [H, W, C] or [C, H, W]; got {list(array.shape)}")
    if array.shape[-1] not in (1, 3, 4):
        array = array.transpose(1, 2, 0)
    array = array[..., :3] if array.shape[-1] >= 3 else array[..., :1]
    if array.dtype != np.uint8:
        array = (255 * array.astype(np.float64)).round().clip(0, 255).astype(np.uint8)
    return np.ascontiguousarray(np.broadcast_to(array, (*array.shape[:2], 3)))


def write_mp4(file: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Writes ``[H, W, 3]`` RGB frames as MPEG-4 with OpenCV.

    Raises:
        OSError: if OpenCV cannot write the file; the reason is unknown.
        ValueError: without frames, and for frames of several sizes.
    """
    import cv2

    writer, written = None, 0
    try:
        for frame in _of_one_size(frames):
            height, width = frame.shape[:2]
            frame = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            if writer is None:
                from torch_denkf.deployment.files import name_for_c  # imported here, as it imports torchrl

                writer = cv2.VideoWriter(name_for_c(file), cv2.VideoWriter.fourcc(*"mp4v"), fps, frame.shape[1::-1])
                if not writer.isOpened():
                    raise OSError(f"OpenCV cannot write {file}; pass a .gif, or look at the folder's permissions")
            writer.write(np.ascontiguousarray(frame[..., ::-1]))
            written += 1
    finally:
        if writer is not None:
            writer.release()
    # OpenCV ignores write errors: a full disk is detected by reading the file.
    capture = cv2.VideoCapture(str(file), cv2.CAP_FFMPEG)
    whole = capture.isOpened() and round(capture.get(cv2.CAP_PROP_FRAME_COUNT)) >= written
    capture.release()
    if not whole:
        raise OSError(errno.EIO, "OpenCV could not write all frames")


def write_gif(file: Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Writes ``[H, W, 3]`` RGB frames as an endless GIF, each with its own 256 colours.

    Pillow's ``save_all`` keeps all frames in memory; here each is written at once.

    Raises:
        ImportError: without pillow.
        ValueError: without frames, and for frames of several sizes.
    """
    try:
        from PIL import GifImagePlugin, Image
    except ImportError as error:
        raise ImportError('GIF files need pillow: pip install "torch_denkf[plots]"') from error
    frames = _of_one_size(frames)
    first = next(frames)  # raises before the file is created
    with open(file, "wb") as out:
        height, width = first.shape[:2]
        out.write(_GIF_HEAD + width.to_bytes(2, "little") + height.to_bytes(2, "little") + bytes(3) + _GIF_FOREVER)
        for number, frame in enumerate(_chain(first, frames)):
            hundredths = round(100 * (number + 1) / fps) - round(100 * number / fps)
            image = Image.fromarray(frame).quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
            for block in GifImagePlugin.getdata(image, duration=10 * hundredths, include_color_table=True):
                out.write(block)
        out.write(b";")


def _chain(first: np.ndarray, rest: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    yield first
    yield from rest


def _of_one_size(frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    shape = None
    for number, frame in enumerate(frames):
        shape = frame.shape if shape is None else shape
        if frame.shape != shape:
            raise ValueError(f"frame {number} has shape {list(frame.shape)}, the first one {list(shape)}")
        yield frame
    if shape is None:
        raise ValueError("a video needs frames; got none")
