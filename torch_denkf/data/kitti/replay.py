"""KITTI's odometry drives as one of torchrl's data sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import Writer
from torchrl.envs.transforms import Transform

from torch_denkf.data.kitti.drive import _choose_camera
from torch_denkf.data.kitti.episodes import Episode, find_cameras, find_drives, read_drives
from torch_denkf.data.kitti.frames import MOTION_KEYS, frames_at
from torch_denkf.data.kitti.gaps import steps_at
from torch_denkf.data.kitti.mirror import mirror_drive
from torch_denkf.data.replay import EpisodeReplay, choose_sampler, whole_episode

__all__ = ["KITTIOdometryExperienceReplay"]


class KITTIOdometryExperienceReplay(EpisodeReplay):
    """Drives in the layout of KITTI's odometry benchmark, as a replay buffer of their frames.

    Episodes, one for each drive, camera and mirror image, lie one behind the other, so that torchrl's slice samplers
    cut sub-sequences out of them. A sample, batch size ``[n]``, has

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``pixels``            [n,2C,H,W]   float32: frame t in [0, 1], then the difference of frames t and t-1
    ``flow``, ``road``    [n,3,h,w]..  float32, where ``flow`` adds them: see :func:`torch_denkf.data.with_motion`
    ``state``             [n,5]        float32, the truth: x m, y m, θ rad, v m/s, θ_dot rad/s
    ``observed``          [n,1]        bool: frames t and t-1 are both there
    ``is_init``           [n,1]        bool: the first row of an episode, or of a slice
    ``time``, ``dt``      [n,1]        float64 and float32, s
    ``frame``             [n,1]        int64, the frame's number in the drive
    ``calibration``       [n,4]        float32: fx, fy, cx, cy in pixels of ``size``
    ``episode``           [n]          int64, a number in ``episodes``
    ``next``: ``done``,   [n,1]        bool: ``truncated`` and ``done`` in the last row of an episode, or of a slice;
    ``truncated``,                     never ``terminated``. The three at the root are False.
    ``terminated``
    ===================== ============ ===========================================================================

    as :func:`torch_denkf.data.frames_at` makes them; the next frame is the next row. The buffer itself stores numbers
    alone: pixels and flow come, when rows are sampled, from the drives' memory-mapped frames, so that neither float
    images nor mirrored copies are kept. All of KITTI takes 0.5 GB on disk at 50 x 150 in colour for each camera.

    Poses are those of the left grey camera, as in the benchmark; the others are beside it, at most 0.5 m.

    Args:
        root: folder that holds ``sequences`` and ``poses``.
        drives: names of the drives, such as ``["00", "02"]``; by default all that have images and poses.
        cameras: ``"first"`` as :func:`torch_denkf.data.read_kitti_drive` chooses it; ``"both"`` for each of
            ``image_2`` and ``image_3`` that has images, or else of ``image_0`` and ``image_1``; or names of folders,
            which every drive must have.
        mirrored: True adds each episode's mirror image, see :func:`torch_denkf.data.mirror_drive`.
        colour: True for three channels, False for a grey one, None for what the files have.
        size: (H, W) to scale the images to.
        flow: True adds ``"flow"`` and ``"road"`` by :func:`torch_denkf.data.with_motion`, kept in the same cache. Or
            what else adds ``"flow"`` to a drive, called once for each drive and camera, such as
            ``partial(with_motion, keep_images=False)``: samples then have no pixels.
        batch_size: rows of a sample.
        num_slices: slices of a sample, each of ``batch_size / num_slices`` rows in a sequence; reshape the sample to
            ``[num_slices, -1]``. Exclusive with ``slice_len`` and ``sampler``.
        slice_len: rows of a slice, instead.
        strict_length: False lets episodes that are shorter than a slice come as short slices.
        sampler: by default slices if they are asked for, else single rows at random.
        writer: by default one that refuses to write.
        collate_fn: as in torchrl's buffers, like ``pin_memory`` and ``prefetch``.
        pin_memory: whether samples are pinned.
        prefetch: samples to prepare in advance, by threads.
        transform: applied to each sample after the pixels are made.
        cache: where decoded drives are kept, see :func:`torch_denkf.data.read_kitti_drive`.
        progress: whether a bar shows the images that are decoded.

    Attributes:
        episodes: what each ``"episode"`` is: drive, camera, mirrored, first row and length.

    Raises:
        FileNotFoundError: without the folder, a drive's images, poses or calibration.
        ValueError: for options out of range, episodes that are shorter than a slice, and files that contradict each
            other, see :func:`torch_denkf.data.read_kitti_drive`.

    Examples:
        >>> from torch_denkf.data import write_drives
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> names = write_drives(folder, ["town", "hill"], frames=12)
        >>> data = KITTIOdometryExperienceReplay(folder, mirrored=True, batch_size=20, num_slices=4, cache=None)
        >>> len(data), len(data.episodes), data.episodes[1].drive, data.episodes[1].mirrored
        (48, 4, 'hill', True)
        >>> batch = data.sample().reshape(4, -1)
        >>> batch["pixels"].shape, batch["state"].shape
        (torch.Size([4, 5, 6, 50, 150]), torch.Size([4, 5, 5]))
        >>> data.statistics["velocity", "std"].shape
        torch.Size([2])
    """

    episodes: tuple[Episode, ...]

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
        batch_size: int | None = None,
        num_slices: int | None = None,
        slice_len: int | None = None,
        strict_length: bool = True,
        sampler: Sampler | None = None,
        writer: Writer | None = None,
        collate_fn: Callable | None = None,
        pin_memory: bool = False,
        prefetch: int | None = None,
        transform: Transform | Callable | None = None,
        cache: str | Path | bool | None = True,
        progress: bool = True,
    ):
        sampler = choose_sampler(sampler, num_slices, slice_len, strict_length)
        self.root = Path(root).expanduser().resolve()
        sources = []
        for name in find_drives(self.root, drives):
            for camera in find_cameras(self.root, name, cameras):
                sources.append((name, _choose_camera(self.root / "sequences" / name, camera)))
        self._drives = read_drives(
            self.root, sources, size=size, colour=colour, cache=cache, flow=flow, progress=progress
        )
        episodes: list[Episode] = []
        rows = []
        for (name, camera), drive in zip(sources, self._drives, strict=True):
            for mirror in (False, True) if mirrored else (False,):
                start = episodes[-1].start + episodes[-1].length if episodes else 0
                rows.append(_rows(drive, len(episodes), size[1] if mirror else None))
                episodes.append(Episode(name, camera, mirror, start, len(drive)))
        super().__init__(
            torch.cat(rows),
            episodes,
            _SampledFrames(self._drives, [episode.mirrored for episode in episodes]),
            sampler=sampler,
            batch_size=batch_size,
            writer=writer,
            transform=transform,
            collate_fn=collate_fn,
            pin_memory=pin_memory,
            prefetch=prefetch,
        )

    def _say_short(self, short: Sequence[Episode]) -> str:
        lengths = {f"{episode.drive}/{episode.camera}": episode.length for episode in short}
        return f"these drives are shorter: {lengths}; leave them out with drives=...,"

    @cached_property
    def statistics(self) -> TensorDict:
        """Means and standard deviations over this data set, for standardising what a network reads and predicts.

        Make the data set of the training drives, and use its statistics wherever the network runs: figures that are
        computed over validation or test drives tell the network about them.

        ========================== ============ ======================================================================
        key                        shape        of
        ========================== ============ ======================================================================
        ``("velocity", "mean")``   [2]          v m/s and θ_dot rad/s of all rows; θ_dot's is 0 if mirrored
        ``("velocity", "std")``    [2]
        ``("pixels", "mean")``     [2C,1,1]     each channel of ``pixels``, if there are any: frames over rows whose
        ``("pixels", "std")``      [2C,1,1]     frame is there, differences over rows that are observed
        ========================== ============ ======================================================================

        Standard deviations divide by the number of values. The pixels' are computed once, by a pass over all frames.
        """
        velocity = self._storage[:]["state"][:, 3:].double()
        statistics = {"velocity": {"mean": velocity.mean(0), "std": velocity.std(0, correction=0)}}
        if "image" in self._drives[0]:
            statistics["pixels"] = _pixel_statistics(self._drives)
        return TensorDict(statistics).float()

    def _is_downloaded(self) -> bool:
        return (self.root / "sequences").is_dir()

    @property
    def _not_ours(self) -> str:
        return f"the frames in {self.root} were not written by this data set; delete them by hand"


class _SampledFrames(Transform):
    """Adds pixels and flow to rows of the buffer, from the frames of their drives."""

    def __init__(self, drives: Sequence[TensorDictBase], mirrored: Sequence[bool]):
        super().__init__()
        self._mirrored = list(mirrored)
        copies = len(self._mirrored) // len(drives)
        self._drives = [drive for drive in drives for _ in range(copies)]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        episode, frame = tensordict["episode"].reshape(-1), tensordict["frame"].reshape(-1)
        out: dict[str, Tensor] = {}
        for number in episode.unique().tolist():
            at = (episode == number).nonzero().squeeze(-1)
            drive = self._drives[number]
            sampled = frames_at(drive, frame[at] - drive["frame"][0]).select("pixels", *MOTION_KEYS, strict=False)
            if self._mirrored[number]:
                sampled = mirror_drive(sampled)
            for key, value in sampled.items():
                out.setdefault(key, value.new_empty(len(frame), *value.shape[1:]))[at] = value
        tensordict = tensordict.copy()  # data[:] hands out the storage itself
        for key, value in out.items():
            tensordict.set(key, value.reshape(*tensordict.batch_size, *value.shape[1:]))
        return tensordict


def _rows(drive: TensorDictBase, episode: int, mirrored_width: int | None) -> TensorDict:
    """What the buffer stores of an episode."""
    count = len(drive)
    rows = drive.select("state", "time", "dt", "frame", "calibration")
    if mirrored_width is not None:
        rows = mirror_drive(rows, width=mirrored_width)
    entries = {
        "observed": steps_at(drive, torch.arange(count)) > 0,
        "episode": torch.full((count,), episode),
        **whole_episode(count),
    }
    return rows.clone().update(entries)


def _pixel_statistics(drives: Sequence[TensorDictBase], chunk: int = 256) -> dict[str, Tensor]:
    total = square = count = torch.zeros((), dtype=torch.float64)
    for drive in drives:
        for index in torch.arange(len(drive)).split(chunk):
            frames = frames_at(drive, index)
            pixels = frames["pixels"]
            # What is missing is zero and adds nothing to the sums; summed by image first, float32 is exact enough.
            total = total + pixels.sum((-2, -1)).double().sum(0)
            square = square + pixels.square().sum((-2, -1)).double().sum(0)
            seen = torch.stack([drive["frame_valid"][index].sum(), frames["observed"].sum()]).double()
            count = count + seen.repeat_interleave(pixels.shape[1] // 2) * pixels[0, 0].numel()
    mean = total / count.clamp_min(1)
    std = (square / count.clamp_min(1) - mean.square()).clamp_min(0).sqrt()
    return {"mean": mean[:, None, None], "std": std[:, None, None]}
