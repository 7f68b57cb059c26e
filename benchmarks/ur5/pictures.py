"""Pictures of saved beliefs: a video, joints with bands (the paper's Fig. 5), paths (Fig. 6), ensemble sizes (Fig. 7).

A belief is an ``.npz`` of one demo: ``pixels`` uint8 [T,H,W,3], ``truth``, ``mean``, ``var`` [T,10], ``ensemble``
[T,E,10] and ``observed`` [T]; the state is J1..J6 and the gripper's opening J7 in rad, and x, y, z in m.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import torch
from matplotlib.collections import PolyCollection
from matplotlib.ticker import MaxNLocator

from benchmarks.common.plots import BAND, draw_band, plt, save
from torch_denkf._files import replacing
from torch_denkf.applications.ur5 import UR5TableEnv
from torch_denkf.plots._frames import write_mp4

STEP = 0.08  # s
NAMES = ("J1", "J2", "J3", "J4", "J5", "J6", "J7, gripper", "x", "y", "z")
FACTORS = np.array([180 / np.pi] * 7 + [100.0] * 3)  # to degrees and centimetres
KEYS = {"pixels": 4, "truth": 2, "mean": 2, "var": 2, "ensemble": 3, "observed": 1}  # and their dimensions
MISSED = "#d62728"


def read_belief(npz: Path | str) -> dict[str, np.ndarray]:
    """Reads a saved belief and checks that it is whole.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if an entry has other dimensions, or another number of steps; names file and entry.
    """
    with np.load(npz) as saved:
        missing = sorted(KEYS.keys() - saved.files)
        if missing:
            raise KeyError(f"{npz} lacks {missing}; it holds {sorted(saved.files)}")
        belief = {key: saved[key] for key in KEYS}
    belief["observed"] = belief["observed"].reshape(len(belief["observed"]), -1).all(-1)
    steps = len(belief["truth"])
    for key, ndim in KEYS.items():
        if belief[key].ndim != ndim or len(belief[key]) != steps:
            raise ValueError(f"{npz}: {key!r} has shape {belief[key].shape}, not {ndim} dimensions of {steps} steps")
    return belief


# ------------------------------------------------------------------------------------------------------------ video


def draw_video(npz: Path | str, path: Path | str, *, domain: str = "sim", ghosts: int = 10, panel: int = 400) -> None:
    """Draws the demo as a video, at the demo's own speed: 12.5 frames a second.

    Left the camera, with a red frame where the filter did not see it; right the arm at the belief's mean in orange
    ghosts, some members of its ensemble; below the widest of the joints' 90 % bands, and that joint's error.

    Args:
        npz: see :func:`read_belief`.
        path: mp4; H.264 where PyAV is installed, else MPEG-4 by OpenCV.
        domain: of the demo, for the camera's place and the light.
        ghosts: members to draw, the first ones.
        panel: height of a panel in pixels, about; the camera's pixels are enlarged a whole number of times.

    Raises:
        RuntimeError: if there is no OpenGL; the message names the packages.
    """
    belief = read_belief(npz)
    factor = max(1, round(panel / belief["pixels"].shape[1]))
    height, width = (side * factor for side in belief["pixels"].shape[1:3])
    env = UR5TableEnv("pick", domain, size=(height, width), pixels_dtype=torch.uint8, render_at=())
    env.set_seed(0)
    env.reset()  # for the light
    try:
        _write_video(path, _video_frames(belief, env, factor, ghosts))
    finally:
        env.close()


def _video_frames(belief: dict[str, np.ndarray], env: UR5TableEnv, factor: int, ghosts: int) -> Iterator[np.ndarray]:
    height, width = env.size
    strip, left, right, top, bottom = _strip(belief, 2 * width)
    steps = len(belief["mean"])
    for t in range(steps):
        camera = belief["pixels"][t].repeat(factor, 0).repeat(factor, 1)
        mean, members = (torch.from_numpy(belief[key][t]) for key in ("mean", "ensemble"))
        drawn = env.render_state(mean, ghosts=members[:ghosts], scenery=False)
        estimate = np.ascontiguousarray(drawn.permute(1, 2, 0).numpy())
        _write(camera, "camera")
        _write(estimate, f"belief: mean, {min(ghosts, len(members))} members (orange)")
        if not belief["observed"][t]:
            cv2.rectangle(camera, (3, 3), (width - 4, height - 4), (214, 39, 40), 7)
            _write(camera, "not seen", line=1)
        now = strip.copy()
        column = left + round((right - left) * t / max(steps - 1, 1))
        now[top:bottom, column + 2 : right] = 255  # the future
        now[top:bottom, column : column + 2] = 0
        frame = np.vstack([np.hstack([camera, estimate]), now])
        yield frame[: len(frame) // 2 * 2, : frame.shape[1] // 2 * 2]  # H.264 takes even sizes


def _write(picture: np.ndarray, text: str, line: int = 0) -> None:
    """White text on a dark box, in the upper left corner."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
    x, y = 16, 34 + 28 * line
    picture[y - height - 4 : y + below + 2, x - 4 : x + width + 4] //= 3
    cv2.putText(picture, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (255, 255, 255), 1, cv2.LINE_AA)


def _strip(belief: dict[str, np.ndarray], width: int) -> tuple[np.ndarray, int, int, int, int]:
    """The whole demo's strip ``[H, width, 3]``, and the box of its axes: left, right, top, bottom in pixels."""
    error = np.abs(belief["mean"] - belief["truth"])[:, :7] * FACTORS[:7]
    band = BAND * np.sqrt(belief["var"][:, :7]) * FACTORS[:7]
    widest, rows = band.argmax(-1), np.arange(len(band))
    figure, axis = plt.subplots(figsize=(width / 100, 1.7), dpi=100)
    figure.subplots_adjust(left=64 / width, right=1 - 16 / width, bottom=0.27, top=0.86)
    seconds = rows * STEP
    axis.fill_between(seconds, band[rows, widest], step="mid", color="tab:blue", alpha=0.35, linewidth=0)
    axis.plot(seconds, error[rows, widest], "k-", linewidth=1)
    axis.set(xlim=(0, max(seconds[-1], STEP)), ylim=(-0.04 * axis.get_ylim()[1], None), ylabel="degrees", xlabel="s")
    _shade(axis, belief["observed"])
    title = "half width of the widest joint's 90 % band (blue), that joint's error (black), frames not seen (red)"
    axis.set_title(title, fontsize=9)
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()
    box = axis.get_window_extent()
    plt.close(figure)
    height = len(picture)
    inner = round(box.x0) + 1, round(box.x1) - 1, height - round(box.y1) + 1, height - round(box.y0) - 1
    return picture, *inner


def _write_video(path: Path | str, frames: Iterable[np.ndarray]) -> None:
    """Writes RGB frames, one a step."""
    with replacing(path) as beside:
        _encode(beside, frames)


def _encode(path: Path, frames: Iterable[np.ndarray]) -> None:
    try:
        import av
    except ImportError:  # it comes with the extra [lerobot] only
        write_mp4(path, frames, 1 / STEP)
        return
    with av.open(str(path), "w") as container:
        rate = Fraction(1 / STEP).limit_denominator(100)
        stream = container.add_stream("libx264", rate=rate, pix_fmt="yuv420p", options={"crf": "18"})
        for number, frame in enumerate(frames):
            if number == 0:  # now the encoder opens
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        container.mux(stream.encode())


# --------------------------------------------------------------------------------------------------------- pictures


def draw_joints(npz: Path | str, path: Path | str, title: str = "") -> None:
    """Draws all ten numbers over time: truth, mean and 90 % band, red where no frame was seen (the paper's Fig. 5).

    Args:
        npz: see :func:`read_belief`.
        path: PNG.
        title: headline.
    """
    belief = read_belief(npz)
    seconds = np.arange(len(belief["truth"])) * STEP
    truth, mean = belief["truth"] * FACTORS, belief["mean"] * FACTORS
    std = np.sqrt(belief["var"]) * FACTORS
    figure, axes = plt.subplots(5, 2, figsize=(12, 12), sharex=True, layout="constrained")
    for dim, axis in enumerate(axes.T.flat):
        draw_band(axis, seconds, mean[:, dim], std[:, dim], truth[:, dim])
        _shade(axis, belief["observed"])
        axis.set(ylabel=f"{NAMES[dim]}, {'deg' if dim < 7 else 'cm'}", xlim=(0, seconds[-1]))
    axes[-1, 0].set_xlabel("s")
    axes[-1, 1].set_xlabel("s")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    if not belief["observed"].all():
        handles.append(plt.Rectangle((0, 0), 1, 1, color=MISSED, alpha=0.15, linewidth=0))
        labels.append("no frame seen")
    figure.legend(handles, labels, ncols=4, loc="outside lower center")
    if title:
        figure.suptitle(title)
    save(figure, path)


def draw_end_effector(npzs: Sequence[Path | str], path: Path | str, titles: Sequence[str] = ()) -> None:
    """Draws the end effector's way in space, true and believed, a panel for each demo (the paper's Fig. 6).

    Args:
        npzs: see :func:`read_belief`.
        path: PNG.
        titles: one a demo; the files' names by default.
    """
    columns = min(3, len(npzs))
    rows = -(-len(npzs) // columns)
    size = {"figsize": (4.8 * columns, 0.5 + 4.4 * rows), "subplot_kw": {"projection": "3d"}, "squeeze": False}
    figure, axes = plt.subplots(rows, columns, **size)
    figure.subplots_adjust(left=0.01, right=0.95, bottom=0.06 / rows, top=0.96, wspace=0.1, hspace=0.08)
    for number, axis in enumerate(axes.flat):
        if number >= len(npzs):
            axis.set_axis_off()
            continue
        belief = read_belief(npzs[number])
        truth, mean = belief["truth"][:, 7:] * 100, belief["mean"][:, 7:] * 100
        for member in np.moveaxis(belief["ensemble"][:, :8, 7:] * 100, 1, 0):
            axis.plot(*member.T, color="tab:orange", alpha=0.25, linewidth=0.6)
        axis.plot([], [], [], color="tab:orange", alpha=0.6, label="members")
        axis.plot(*truth.T, "k-", linewidth=1.5, label="truth")
        axis.plot(*mean.T, color="tab:blue", linewidth=1.2, label="mean of the belief")
        unseen = ~belief["observed"]
        if unseen.any():
            axis.plot(*mean[unseen].T, ".", color=MISSED, markersize=4, label="no frame seen")
        axis.plot(*truth[:1].T, "ko", markersize=5, label="start")
        title = titles[number] if number < len(titles) else Path(npzs[number]).stem
        axis.set_title(f"{title}: {np.linalg.norm(mean - truth, axis=-1).mean():.2f} cm on average", y=1.0, fontsize=11)
        axis.set(xlabel="x, cm", ylabel="y, cm", zlabel="z, cm")
        _equal_scales(axis, np.concatenate([truth, mean]))
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=len(labels), loc="lower center")
    save(figure, path)


def draw_ensemble_size(rows: Iterable[dict], path: Path | str) -> None:
    """Draws error and time against the number of members (the paper's Fig. 7): each row a dot, their means a line.

    Args:
        rows: of a csv, numbers or text, with ``ensemble_size``, ``joint_mae_deg``, ``ee_mae_cm``, ``ms_per_step``.
        path: PNG.

    Raises:
        ValueError: without rows.
        KeyError: if a row lacks a column.
    """
    columns = {
        "joint_mae_deg": "joints, mean absolute error, deg",
        "ee_mae_cm": "end effector, mean absolute error, cm",
        "ms_per_step": "time, ms a step",
    }
    table = np.array([[float(row[key]) for key in ("ensemble_size", *columns)] for row in rows])
    if not len(table):
        raise ValueError("no rows: nothing to draw over ensemble sizes")
    sizes = np.unique(table[:, 0])
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    for column, (axis, label) in enumerate(zip(axes, columns.values(), strict=True), start=1):
        means = [table[table[:, 0] == size, column].mean() for size in sizes]
        if len(table) > len(sizes):
            axis.plot(table[:, 0], table[:, column], ".", color="tab:blue", alpha=0.35, markersize=6)
        axis.plot(sizes, means, "o-", color="tab:blue")
        axis.set_xscale("log", base=2)
        axis.set_xticks(sizes, [f"{size:.0f}" for size in sizes])
        axis.minorticks_off()
        axis.set(xlabel="members", title=label, ylim=(0, 1.08 * table[:, column].max()))
        axis.grid(alpha=0.3)
    save(figure, path)


def _shade(axis, observed: np.ndarray) -> None:
    """Shades the steps that were not seen, each half a step to both sides."""
    starts = np.flatnonzero(~observed) * STEP
    low, high = axis.get_ylim()
    bars = [[(t - STEP / 2, -1e6), (t - STEP / 2, 1e6), (t + STEP / 2, 1e6), (t + STEP / 2, -1e6)] for t in starts]
    axis.add_collection(PolyCollection(bars, color=MISSED, alpha=0.15, linewidth=0), autolim=False)
    axis.set_ylim(low, high)


def _equal_scales(axis, points: np.ndarray) -> None:
    """A cube around all points, so that a centimetre is a centimetre along each axis."""
    centre, half = (points.max(0) + points.min(0)) / 2, max(float(np.ptp(points, axis=0).max()) / 2 * 1.05, 1e-3)
    for set_limits, middle in zip((axis.set_xlim, axis.set_ylim, axis.set_zlim), centre, strict=True):
        set_limits(middle - half, middle + half)
    for ticks in (axis.xaxis, axis.yaxis, axis.zaxis):
        ticks.set_major_locator(MaxNLocator(4))
    axis.set_box_aspect((1, 1, 1), zoom=0.87)
