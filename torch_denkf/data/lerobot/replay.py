"""Recordings of real robots as one of torchrl's data sets."""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Unpack

import torch
from torch import Tensor

from torch_denkf.data.episodes import Episode
from torch_denkf.data.lerobot.recording import DecodedRecording, read_recording
from torch_denkf.data.options import ReplayOptions, check_options
from torch_denkf.data.pictures import JoinedPictures, check_size, float_pictures
from torch_denkf.data.replay import EpisodeReplay
from torch_denkf.data.statistics import picture_statistics

__all__ = ["LeRobotReplay"]

_FOLD = 5  # one episode of so many is for tests


@dataclass(frozen=True)
class LeRobotEpisode(Episode):
    """One episode of a recording.

    Attributes:
        number: the recording's own.
    """

    number: int


def is_for_tests(number: int) -> bool:
    """Whether an episode is the one of its five that is for tests; it does not depend on the others."""
    block, place = divmod(number, _FOLD)
    return hashlib.sha256(f"torch_denkf {block}".encode()).digest()[0] % _FOLD == place


class LeRobotReplay(EpisodeReplay):
    """Episodes of a robot's camera and joints, in LeRobot's format, as a replay buffer of their frames.

    TorchRL's ``LeRobotExperienceReplay`` downloads from the hub and decodes videos when it samples, for
    vision-language-action models. This class reads a folder, decodes once, to the size that a filter's sensor reads,
    and hands out what a filter and its loss take. Keys, samples and splits are those of
    :class:`~torch_denkf.data.EpisodeReplay`; here the readings are

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``pixels``            [n,3,H,W]    float32 in [0, 1], RGB; zeros where the frame is missing
    ``state``             [n,S]        float32, such as the joints' positions, in the recording's units
    ``action``            [n,A]        float32, where there are any
    ``observed``          [n,1]        bool: the frame is there, and its row is sound
    ===================== ============ ===========================================================================

    Rows whose state or action is not finite, or whose time does not increase, keep their place and are not observed; a
    warning counts them. Where numbers are not finite, the row holds the last ones that are, is False in
    ``state_observed`` or ``action_observed``, and is left out of losses by ``("collector", "mask")``.

    Frames are kept as uint8 at the size asked for, memory-mapped: 37 kB a frame of 96 x 128. All splits share an entry
    of the cache.

    Versions 2.0, 2.1 and 3.0 of the format are read, with videos or images. OpenCV decodes H.264 and others; AV1,
    LeRobot's default, needs PyAV, which comes with ``pip install 'torch_denkf[lerobot]'`` as does pyarrow for the
    parquet files. A video's frame belongs to the row whose time it is nearest to, so that a damaged one blinds its own
    row alone.

    Of the episodes 0 to 4, 5 to 9 and so on one each is for tests, drawn by a hash.

    Args:
        root: folder that holds ``meta`` and ``data``; or a recording that
            :func:`torch_denkf.data.recording_from_rows` made, which has its camera, keys and size already.
        camera: key of the camera, such as ``"observation.images.top"`` or ``"top"``; None for the only one.
        state_key: feature of the state.
        action_key: feature of the action; None for none, as are data sets without an ``"action"``.
        size: (H, W) to scale the images to, whatever their aspect.
        **options: of :class:`~torch_denkf.data.EpisodeReplay`.

    Attributes:
        episodes: of this split, with the recording's own ``number``.
        fps: rows a second.
        names: of the state's numbers, such as the joints; None where the recording names none.

    Raises:
        ImportError: without pyarrow.
        FileNotFoundError: without the folder, a parquet file or a video.
        ValueError: for versions of the format that are not read, cameras and features that are not there, files that
            are damaged or contradict the metadata, splits without episodes, episodes that are shorter than a slice.

    Examples:
        >>> data = LeRobotReplay("aloha_static_coffee", camera="cam_high", slice_len=16, batch_size=64)
        ... # doctest: +SKIP
        >>> data.sample()["pixels"].shape  # doctest: +SKIP
        torch.Size([4, 16, 3, 96, 128])

        Rows that are in memory already:

        >>> from tensordict import TensorDict
        >>> from torch_denkf.data import recording_from_rows
        >>> rows = TensorDict(
        ...     {
        ...         "observation": {"image": torch.zeros(60, 3, 8, 8, dtype=torch.uint8), "state": torch.rand(60, 7)},
        ...         "episode": torch.arange(10).repeat_interleave(6),
        ...     },
        ...     batch_size=[60],
        ... )
        >>> data = LeRobotReplay(recording_from_rows(rows, fps=10.0), num_slices=3, slice_len=4)
        >>> data.sample()["state"].shape
        torch.Size([3, 4, 7])
        >>> len(data.episodes), data.statistics["state", "std"].shape
        (8, torch.Size([7]))
    """

    episodes: tuple[LeRobotEpisode, ...]

    def __init__(
        self,
        root: str | Path | DecodedRecording,
        *,
        camera: str | None = None,
        state_key: str = "observation.state",
        action_key: str | None = "action",
        size: tuple[int, int] = (96, 128),
        **options: Unpack[ReplayOptions],
    ):
        check_options(options)
        if isinstance(root, DecodedRecording):
            recording = root
        else:
            recording = read_recording(
                Path(root).expanduser().resolve(),
                camera=camera,
                state_key=state_key,
                action_key=action_key,
                size=check_size(size),
                cache=options.get("cache", True),
                progress=options.get("progress", True),
            )
        self.fps, self.names = recording.fps, recording.names
        self._images = JoinedPictures([recording.rows["image"]])
        numbers, lengths = torch.unique_consecutive(recording.rows["episode"], return_counts=True)
        starts = (lengths.cumsum(0) - lengths).tolist()
        super().__init__(
            recording.rows.exclude("image", "episode", "frame").set("step", recording.rows["frame"]),
            [
                LeRobotEpisode(f"episode_{number:06d}", start, length, number)
                for number, start, length in zip(numbers.tolist(), starts, lengths.tolist(), strict=True)
            ],
            for_tests=lambda episode: is_for_tests(episode.number),
            pictures=partial(float_pictures, self._images),
            root=recording.source,
            **options,
        )

    def _picture_statistics(self, index: Tensor) -> dict[str, Tensor]:
        return picture_statistics(self._images, index[self._all_rows["observed"].squeeze(-1)[index]])


def __getattr__(name: str):
    if name == "LeRobotExperienceReplay":
        warnings.warn(
            "LeRobotExperienceReplay is the name of one of torchrl's classes; the one here is now called LeRobotReplay",
            DeprecationWarning,
            stacklevel=3,
        )
        return LeRobotReplay
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
