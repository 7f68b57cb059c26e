"""TorchRL data set of KITTI's odometry drives."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Unpack

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf.applications.car.kitti.drive import choose_camera
from torch_denkf.applications.car.kitti.episodes import KITTIEpisode, find_cameras, find_drives, read_drives
from torch_denkf.applications.car.kitti.frames import MOTION_KEYS, frames_at
from torch_denkf.applications.car.kitti.gaps import steps_at
from torch_denkf.applications.car.kitti.mirror import mirror_drive
from torch_denkf.data.episodes import hashed_tests
from torch_denkf.data.options import ReplayOptions, check_options
from torch_denkf.data.replay import EpisodeReplay
from torch_denkf.data.statistics import mean_and_std

__all__ = ["KITTIOdometryExperienceReplay"]


class KITTIOdometryExperienceReplay(EpisodeReplay):
    """Replay buffer of drives in the layout of KITTI's odometry benchmark.

    An episode is a drive of one camera, or its mirror image. Keys, samples and splits are those of
    :class:`~torch_denkf.data.EpisodeReplay`; here the readings are

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``pixels``            [n,2C,H,W]   float32: frame t in [0, 1], then the difference of frames t and t-1
    ``flow``, ``road``    [n,3,h,w]..  float32, if ``flow`` adds them, see ``with_motion``
    ``state``             [n,5]        float32, ground truth: x m, y m, θ rad, v m/s, θ_dot rad/s
    ``observed``          [n,1]        bool: frames t and t-1 both exist
    ``dt``                [n,1]        float32, s: the drive's median frame time
    ``frame``             [n,1]        int64, the frame's number in the drive
    ``calibration``       [n,4]        float32: fx, fy, cx, cy in pixels of ``size``
    ===================== ============ ===========================================================================

    as :func:`torch_denkf.applications.car.kitti.frames.frames_at` makes them. Pixels and flow are computed from the
    drives' memory-mapped frames when rows are sampled, so that neither float images nor mirrored copies are stored. All
    of KITTI takes 0.5 GB on disk at 50 x 150 in colour for each camera.

    Poses are those of the left grey camera, as in the benchmark; the others are next to it, at most 0.5 m.

    By default all ``drives`` are in the split ``"train"``, and ``test_share`` moves some to ``"test"``. All cameras and
    mirror images of a drive are in the same split.

    Args:
        root: folder with ``sequences`` and ``poses``.
        drives: names of the drives, such as ``["00", "02"]``; by default all that have images and poses.
        cameras: ``"first"`` as :func:`torch_denkf.applications.car.read_kitti_drive` chooses it; ``"both"`` for each of
            ``image_2`` and ``image_3`` that has images, or else of ``image_0`` and ``image_1``; or names of folders,
            which every drive must have.
        mirrored: True adds each episode's mirror image, see
            :func:`torch_denkf.applications.car.kitti.mirror.mirror_drive`.
        colour: True for three channels, False for a grey one, None for the channels of the files.
        size: (H, W) to scale the images to.
        flow: True adds ``"flow"`` and ``"road"`` by :func:`torch_denkf.applications.car.with_motion`, with the same
            cache. A function that adds ``"flow"`` to a drive is called once for each drive and camera, such as
            ``partial(with_motion, keep_images=False)``: samples then have no pixels.
        test_share: share of the drives in the test split, by a hash of their names.
        **options: of :class:`~torch_denkf.data.EpisodeReplay`.

    Attributes:
        episodes: episode of each number in ``"episode"``, with its ``drive``, ``camera`` and whether it is
            ``mirrored``.

    Raises:
        FileNotFoundError: without the folder, a drive's images, poses or calibration.
        ValueError: for options out of range, episodes that are shorter than a slice, and files that contradict each
            other, see :func:`torch_denkf.applications.car.read_kitti_drive`.

    Examples:
        >>> from torch_denkf.applications.car.kitti.render import write_drives
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> names = write_drives(folder, ["town", "hill"], frames=12)
        >>> data = KITTIOdometryExperienceReplay(folder, mirrored=True, num_slices=4, slice_len=5, cache=None)
        >>> len(data), len(data.episodes), data.episodes[1].drive, data.episodes[1].mirrored
        (48, 4, 'hill', True)
        >>> batch = data.sample()
        >>> batch["pixels"].shape, batch["state"].shape
        (torch.Size([4, 5, 6, 50, 150]), torch.Size([4, 5, 5]))
        >>> data.statistics["velocity", "std"].shape
        torch.Size([2])
    """

    episodes: tuple[KITTIEpisode, ...]

    def __init__(
        self,
        root: str | Path,
        drives: Sequence[str | int] | str | int | None = None,
        *,
        cameras: str | Sequence[str] = "first",
        mirrored: bool = False,
        colour: bool | None = True,
        size: tuple[int, int] = (50, 150),
        flow: bool | Callable[[TensorDictBase], TensorDictBase] = False,
        test_share: float = 0.0,
        **options: Unpack[ReplayOptions],
    ):
        check_options(options)
        for_tests = hashed_tests(test_share)
        folder = Path(root).expanduser().resolve()
        sources = []
        for name in find_drives(folder, drives):
            for camera in find_cameras(folder, name, cameras):
                sources.append((name, choose_camera(folder / "sequences" / name, camera)))
        cache, progress = options.get("cache", True), options.get("progress", True)
        self._drives = read_drives(folder, sources, size=size, colour=colour, cache=cache, flow=flow, progress=progress)
        episodes: list[KITTIEpisode] = []
        rows = []
        for (name, camera), drive in zip(sources, self._drives, strict=True):
            for mirror in (False, True) if mirrored else (False,):
                start = episodes[-1].start + episodes[-1].length if episodes else 0
                rows.append(_rows(drive, size[1] if mirror else None))
                label = f"{name}/{camera}/mirrored" if mirror else f"{name}/{camera}"
                episodes.append(KITTIEpisode(label, start, len(drive), drive=name, camera=camera, mirrored=mirror))
        super().__init__(
            torch.cat(rows),
            episodes,
            for_tests=for_tests,
            pictures=_Frames(self._drives, episodes),
            root=folder,
            **options,
        )

    def _number_statistics(self, rows: TensorDictBase) -> dict[str, Any]:
        """Adds statistics of ``"velocity"`` ``[2]``, v m/s and θ_dot rad/s; θ_dot's mean is 0 if mirrored."""
        return {**super()._number_statistics(rows), "velocity": mean_and_std(rows["state"][:, 3:])}

    def _picture_statistics(self, index: Tensor) -> dict[str, Tensor] | None:
        """Returns statistics of frames over rows that have one, and of differences over observed rows."""
        if "image" not in self._drives[0]:
            return None
        copies = len(self._all_episodes) // len(self._drives)  # a mirror image has the same statistics
        roles = self._roles[::copies]
        return _pixel_statistics([drive for drive, role in zip(self._drives, roles, strict=True) if role == "train"])


class _Frames:
    """Computes pixels and flow of rows from the frames of their drives."""

    def __init__(self, drives: Sequence[TensorDictBase], episodes: Sequence[KITTIEpisode]):
        self._drives, self._mirrored = list(drives), [episode.mirrored for episode in episodes]
        self._copies = len(self._mirrored) // len(self._drives)
        self._starts = torch.tensor([episode.start for episode in episodes])

    def __call__(self, row: Tensor) -> dict[str, Tensor]:
        """Returns pixels and flow of rows ``[m]`` of the whole data set."""
        number = torch.searchsorted(self._starts, row, right=True) - 1
        out: dict[str, Tensor] = {}
        for episode in number.unique().tolist():
            at = (number == episode).nonzero().squeeze(-1)
            frames = frames_at(self._drives[episode // self._copies], row[at] - self._starts[episode])
            frames = frames.select("pixels", *MOTION_KEYS, strict=False)
            if self._mirrored[episode]:
                frames = mirror_drive(frames)
            for key, value in frames.items():
                out.setdefault(key, value.new_empty(len(row), *value.shape[1:]))[at] = value
        return out


def _rows(drive: TensorDictBase, mirrored_width: int | None) -> TensorDict:
    """Returns the stored rows of an episode."""
    row = torch.arange(len(drive))
    rows = drive.select("state", "time", "dt", "frame", "calibration")
    if mirrored_width is not None:
        rows = mirror_drive(rows, width=mirrored_width)
    entries = {"observed": steps_at(drive, row) > 0, "step": row.unsqueeze(-1), "time": rows["time"] - rows["time"][0]}
    return rows.clone().update(entries)


def _pixel_statistics(drives: Sequence[TensorDictBase], chunk: int = 256) -> dict[str, Tensor]:
    total = square = count = torch.zeros((), dtype=torch.float64)
    for drive in drives:
        for index in torch.arange(len(drive)).split(chunk):
            frames = frames_at(drive, index)
            pixels = frames["pixels"]
            # Missing frames are zero and do not change the sums; sums over single images are exact enough in float32.
            total = total + pixels.sum((-2, -1)).double().sum(0)
            square = square + pixels.square().sum((-2, -1)).double().sum(0)
            seen = torch.stack([drive["frame_valid"][index].sum(), frames["observed"].sum()]).double()
            count = count + seen.repeat_interleave(pixels.shape[1] // 2) * pixels[0, 0].numel()
    mean = total / count.clamp_min(1)
    std = (square / count.clamp_min(1) - mean.square()).clamp_min(0).sqrt()
    return {"mean": mean[:, None, None], "std": std[:, None, None]}
