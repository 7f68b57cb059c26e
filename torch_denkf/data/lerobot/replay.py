"""Recordings of real robots as one of torchrl's data sets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import Writer
from torchrl.envs.transforms import Transform

from torch_denkf.data.lerobot.episodes import RecordedEpisode, episode_rows, is_for_tests, pixel_statistics
from torch_denkf.data.lerobot.recording import Recording, read_recording
from torch_denkf.data.replay import EpisodeReplay, choose_sampler

__all__ = ["LeRobotExperienceReplay"]


class LeRobotExperienceReplay(EpisodeReplay):
    """Episodes of a robot's camera and joints, in LeRobot's format, as a replay buffer of their frames.

    TorchRL has a class of this name that decodes videos when it samples, for vision-language-action models. This one
    decodes once, to the size that a filter's sensor reads, and hands out what a filter and its loss take.

    Episodes lie one behind the other, so that torchrl's slice samplers cut sub-sequences out of them. A sample, batch
    size ``[n]``, has

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``pixels``            [n,3,H,W]    float32 in [0, 1], RGB; zeros where the frame is missing
    ``state``             [n,S]        float32, such as the joints' positions, in the recording's units
    ``action``            [n,A]        float32, where there are any
    ``observed``          [n,1]        bool: the frame is there
    ``is_init``           [n,1]        bool: the first row of an episode, or of a slice
    ``time``              [n,1]        float64, s since the episode's begin
    ``frame``             [n,1]        int64, the row's number in the episode
    ``episode``           [n]          int64, the recording's number of the episode
    ``next``: ``done``,   [n,1]        bool: ``truncated`` and ``done`` in the last row of an episode, or of a slice;
    ``truncated``,                     never ``terminated``. The three at the root are False.
    ``terminated``
    ===================== ============ ===========================================================================

    The next observation is the next row. Frames are kept as uint8 at the size asked for, memory-mapped: 37 kB a frame
    of 96 x 128.

    Versions 2.0, 2.1 and 3.0 of the format are read, with videos or images. OpenCV decodes H.264 and others; AV1,
    LeRobot's default, needs PyAV, which comes with ``pip install 'torch_denkf[lerobot]'`` as does pyarrow for the
    parquet files. A video's frame belongs to the row whose time it is nearest to, so that a damaged one blinds its own
    row alone.

    The split is by episode: of the numbers 0 to 4, 5 to 9 and so on one each is for tests, drawn by a hash, so that
    episodes that are added later move none.

    Args:
        root: folder that holds ``meta`` and ``data``; or a recording that
            :func:`torch_denkf.data.recording_from_rows` made, which has its camera, keys and size already.
        camera: key of the camera, such as ``"observation.images.top"`` or ``"top"``; None for the only one.
        state_key: feature of the state.
        action_key: feature of the action; None for none, as are data sets without an ``"action"``.
        size: (H, W) to scale the images to, whatever their aspect.
        split: ``"train"`` (80 %), ``"test"`` or ``"all"``.
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
        cache: folder of decoded recordings; True for ``$TORCH_DENKF_CACHE`` or else ``~/.cache/torch_denkf``; None or
            False for none: the frames are then in memory. All splits share an entry.
        progress: whether a bar shows the frames that are decoded.

    Attributes:
        episodes: of this split: number, first row and length.
        fps: rows a second.
        names: of the state's numbers, such as the joints; None where the recording names none.

    Raises:
        ImportError: without pyarrow.
        FileNotFoundError: without the folder, a parquet file or a video.
        ValueError: for versions of the format that are not read, cameras and features that are not there, files that
            are damaged or contradict the metadata, splits without episodes, episodes that are shorter than a slice.

    Examples:
        >>> data = LeRobotExperienceReplay("aloha_static_coffee", camera="cam_high", slice_len=16, batch_size=64)
        ... # doctest: +SKIP
        >>> data.sample().reshape(4, 16)["pixels"].shape  # doctest: +SKIP
        torch.Size([4, 16, 3, 96, 128])

        Rows that are in memory already:

        >>> from torch_denkf.data import recording_from_rows
        >>> rows = TensorDict(
        ...     {
        ...         "observation": {"image": torch.zeros(60, 3, 8, 8, dtype=torch.uint8), "state": torch.rand(60, 7)},
        ...         "episode": torch.arange(10).repeat_interleave(6),
        ...     },
        ...     batch_size=[60],
        ... )
        >>> data = LeRobotExperienceReplay(recording_from_rows(rows, fps=10.0), slice_len=4, batch_size=12)
        >>> data.sample().reshape(3, 4)["state"].shape
        torch.Size([3, 4, 7])
        >>> len(data.episodes), data.statistics["state", "std"].shape
        (8, torch.Size([7]))
    """

    episodes: tuple[RecordedEpisode, ...]

    def __init__(
        self,
        root: str | Path | Recording,
        *,
        camera: str | None = None,
        state_key: str = "observation.state",
        action_key: str | None = "action",
        size: tuple[int, int] = (96, 128),
        split: Literal["train", "test", "all"] = "train",
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
        if split not in ("train", "test", "all"):
            raise ValueError(f"split is 'train', 'test' or 'all', got {split!r}")
        sampler = choose_sampler(sampler, num_slices, slice_len, strict_length)
        if isinstance(root, Recording):
            recording = root
        else:
            height, width = (int(side) for side in size)
            if height < 1 or width < 1:
                raise ValueError(f"size is (height, width) in pixels and must be positive, got {tuple(size)}")
            recording = read_recording(
                Path(root).expanduser().resolve(),
                camera=camera,
                state_key=state_key,
                action_key=action_key,
                size=(height, width),
                cache=cache,
                progress=progress,
            )
        self.root, self.fps, self.names = recording.source, recording.fps, recording.names
        self._recording = recording.rows
        numbers, lengths = torch.unique_consecutive(recording.rows["episode"], return_counts=True)
        self._begin = dict(zip(numbers.tolist(), (lengths.cumsum(0) - lengths).tolist(), strict=True))
        kept = [n for n in numbers.tolist() if split == "all" or is_for_tests(n) == (split == "test")]
        if not kept:
            raise ValueError(
                f"split {split!r} has none of the episodes {numbers.tolist()}: one of each five is for tests, as a "
                "hash has it; pass split='all'"
            )
        length_of = dict(zip(numbers.tolist(), lengths.tolist(), strict=True))
        episodes, rows, start = [], [], 0
        for number in kept:
            episodes.append(RecordedEpisode(number, start, length_of[number]))
            rows.append(episode_rows(recording.rows, self._begin[number], length_of[number]))
            start += length_of[number]
        super().__init__(
            torch.cat(rows),
            episodes,
            _SampledFrames(recording.rows["image"], self._begin),
            sampler=sampler,
            batch_size=batch_size,
            writer=writer,
            transform=transform,
            collate_fn=collate_fn,
            pin_memory=pin_memory,
            prefetch=prefetch,
        )

    def _say_short(self, short: Sequence[RecordedEpisode]) -> str:
        lengths = {episode.number: episode.length for episode in short}
        return f"these episodes are shorter: {lengths};"

    @cached_property
    def statistics(self) -> TensorDict:
        """Means and standard deviations over this split, for standardising what a network reads and predicts.

        Make the data set of the training episodes, and use its statistics wherever the network runs.

        ========================== ============ ======================================================================
        key                        shape        of
        ========================== ============ ======================================================================
        ``("state", "mean")``      [S]          all rows; a joint that never moves has a ``std`` of 0
        ``("state", "std")``       [S]
        ``("action", "mean")``     [A]          where there are actions, likewise ``std``
        ``("pixels", "mean")``     [3,1,1]      each colour, over rows whose frame is there, likewise ``std``
        ========================== ============ ======================================================================

        Standard deviations divide by the number of values. The pixels' are computed once, by a pass over all frames.
        """
        rows = self._storage[:]
        statistics: dict[str, dict[str, Tensor]] = {}
        for key in ("state", "action"):
            if key in rows:
                values = rows[key].double()
                statistics[key] = {"mean": values.mean(0), "std": values.std(0, correction=0)}
        index = torch.cat([self._begin[e.number] + torch.arange(e.length) for e in self.episodes])
        statistics["pixels"] = pixel_statistics(self._recording["image"], index[rows["observed"].squeeze(-1)])
        return TensorDict(statistics).float()

    def _is_downloaded(self) -> bool:
        return self.root is None or (self.root / "meta").is_dir()

    @property
    def _not_ours(self) -> str:
        return f"the recording {self.root or 'in memory'} is not this data set's; delete it by hand"


class _SampledFrames(Transform):
    """Adds pixels to rows of the buffer."""

    def __init__(self, images: Tensor, begin: dict[int, int]):
        super().__init__()
        self._images = images
        self._numbers, order = torch.tensor(list(begin)).sort()
        self._begins = torch.tensor(list(begin.values()))[order]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        episode, frame = tensordict["episode"].reshape(-1), tensordict["frame"].reshape(-1)
        row = frame + self._begins[torch.searchsorted(self._numbers, episode)]
        pixels = self._images[row].float().div_(255)
        tensordict = tensordict.copy()  # data[:] hands out the storage itself
        return tensordict.set("pixels", pixels.reshape(*tensordict.batch_size, *pixels.shape[1:]))
