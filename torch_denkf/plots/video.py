"""Videos: frames to a file, and a belief over time next to the camera's images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.plots._axes import times_of
from torch_denkf.plots._belief import TensorOrKey, entry_of, read_belief
from torch_denkf.plots._frames import as_picture, write_gif, write_mp4
from torch_denkf.plots._scene import Scene
from torch_denkf.plots.bands import plot_bands
from torch_denkf.plots.path import plot_path

__all__ = ["belief_video", "write_video"]


def write_video(file: str | Path, frames: Iterable[Tensor | np.ndarray], fps: float) -> Path:
    """Writes frames one by one, with only one in memory; needs no display.

    Args:
        file: ``.mp4`` is written by OpenCV as MPEG-4, ``.gif`` by pillow with 256 colours per frame. Its folder is
            created.
        frames: images of one size, ``[H, W]``, ``[H, W, C]`` or ``[C, H, W]``, uint8 or floats in [0, 1]; see
            :func:`belief_video` for C. For an MP4, odd heights and widths are padded by one row or column.
        fps: frames per second; at most 50 for a GIF, whose times are hundredths of a second.

    Returns:
        The file.

    Raises:
        ImportError: for a GIF without pillow; the message names the extra.
        ValueError: for another ending, without frames, for frames of several sizes or other shapes, and for ``fps``
            out of range.
        OSError: if the file cannot be written, as on a full disk; an existing file is then unchanged.

    Example:
        >>> import tempfile
        >>> file = write_video(f"{tempfile.mkdtemp()}/grey.gif", (torch.full((8, 8), t / 9) for t in range(10)), fps=25)
        >>> file.name
        'grey.gif'
    """
    file = Path(file)
    writers = {".mp4": write_mp4, ".gif": write_gif}
    if file.suffix.lower() not in writers:
        raise ValueError(f"a video ends with .mp4 or .gif; got {file.name!r}")
    if not fps > 0 or (file.suffix.lower() == ".gif" and fps > 50):
        raise ValueError(f"fps must be positive, and at most 50 for a GIF; got {fps}")
    from torch_denkf.deployment.files import replacing  # imported here, as its package imports the filters

    with replacing(file) as beside:
        writers[file.suffix.lower()](beside, (as_picture(frame) for frame in frames), fps)
    return file


def belief_video(
    file: str | Path,
    run: TensorDictBase | Tensor,
    pixels: Tensor | np.ndarray | NestedKey | None = None,
    *,
    belief: NestedKey = "belief",
    truth: TensorOrKey = None,
    observed: TensorOrKey = None,
    time: float | Tensor | None = None,
    path: Mapping[str, Any] | None = None,
    on_picture: bool = False,
    bands: Mapping[str, Any] | None = None,
    title: str | None = None,
    fps: float | None = None,
    every: int = 1,
    size: tuple[float, float] = (10, 5.6),
    dpi: float = 100,
) -> Path:
    """Writes a video of one sequence: the camera, the path and the bands over time.

    Frames are drawn and written one by one. A red border of the image marks steps that were not observed.

    Args:
        file: ``.mp4`` or ``.gif``, see :func:`write_video`.
        run: a roll-out or sequence of T steps, see :func:`plot_path` and :func:`plot_bands`.
        pixels: pictures ``[T, C, H, W]`` or ``[T, H, W, C]``, or their key; by default ``"pixels"`` of the roll-out if
            it exists. One channel is grey, three are colours. Of more channels the first three are drawn, of two the
            first.
        belief: key of the belief, such as a smoother's ``"smoothed"``.
        truth: ``[T, S']``, or its key; by default ``"state"`` of the roll-out if it exists.
        observed: ``[T, 1]`` bool, or its key; by default ``"observed"`` of the roll-out if it exists.
        time: seconds of the steps ``[T]``, or the seconds between two; by default steps are counted.
        path: keywords of :func:`plot_path` for two dims, such as ``{"forward_up": True}``; ``None`` leaves it out.
        on_picture: whether to draw the path on the camera's picture; ``path`` may be left out. Its dims are then in
            pixels from the middle of the upper left one: the column to the right, then the row downwards.
        bands: keywords of :func:`plot_bands`, such as ``{"dims": [3, 4]}``; ``None`` leaves them out.
        title: title of the figure.
        fps: frames per second; by default in real time, or 10 without ``time``.
        every: draw every n-th step; the default of ``fps`` is adapted.
        size: width and height of a frame in inches.
        dpi: pixels per inch.

    Returns:
        The file.

    Raises:
        ImportError: without matplotlib or pillow; the message names the extra.
        KeyError: if the roll-out lacks a given key.
        ValueError: if there is nothing to draw, and for all errors of the functions above.

    Example:
        >>> import tempfile
        >>> walk = torch.randn(4, 2).cumsum(0)
        >>> file = belief_video(f"{tempfile.mkdtemp()}/walk.gif", walk, path={}, bands={}, size=(3, 2))
        >>> pixels = torch.zeros(4, 3, 8, 8)
        >>> file = belief_video(f"{tempfile.mkdtemp()}/seen.gif", walk + 4, pixels, on_picture=True, size=(3, 3))
    """
    read = read_belief(run, truth, observed, belief=belief, one_sequence=True)
    pictures = entry_of(run, pixels, "pixels")
    if pictures is not None and len(pictures) != len(read.mean):
        raise ValueError(f"pixels must have a picture a step, {len(read.mean)}; got {len(pictures)}")
    if every < 1:
        raise ValueError(f"every counts steps and must be at least 1; got {every}")
    if on_picture:
        path = path or {}
        if pictures is None or path.get("forward_up") or len(path.get("dims", (0, 1))) != 2:
            raise ValueError("on_picture needs pixels, and a path of two dims without forward_up")
    if pictures is None and path is None and bands is None:
        raise ValueError("nothing to draw: pass pixels, path={} or bands={}")
    panels = _panel_count(bands, read.mean.shape[-1])
    scene = Scene(size, dpi, title, pictures, path is not None, panels, on_picture=on_picture)
    if path is not None:
        plot_path(run, truth, belief=belief, ax=scene.path, **path)
    if bands is not None:
        given = {"observed": observed, "time": time, "ax": scene.bands, **bands}
        plot_bands(run, truth, belief=belief, **given)
    scene.freeze(None if read.observed is None else read.observed.any(-1), times_of(time, len(read.mean)))
    frames = (scene.frame(step) for step in range(0, len(read.mean), every))
    return write_video(file, frames, _own_speed(time, every) if fps is None else fps)


def _panel_count(bands: Mapping[str, Any] | None, state_dim: int) -> int:
    if bands is None:
        return 0
    return state_dim if bands.get("dims") is None else len(bands["dims"])


def _own_speed(time: float | Tensor | None, every: int) -> float:
    """Returns the frames per second for real time."""
    if time is None:
        return 10.0 / every
    dt = float(torch.as_tensor(time).flatten().diff().median()) if isinstance(time, Tensor) else time
    return 1.0 / (dt * every)
