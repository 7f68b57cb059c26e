"""TorchRL data set of recordings of real robots."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, Unpack

import torch
from tensordict import TensorDict
from torch import Tensor

from torch_denkf.data.episodes import ROW, Episode
from torch_denkf.data.lerobot.recording import DecodedRecording, read_recording
from torch_denkf.data.lerobot.repeats import repeated_pictures
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
        number: number of the episode in the recording.
    """

    number: int


def is_for_tests(number: int) -> bool:
    """Returns True for test episodes: of each five consecutive numbers, a hash selects one."""
    block, place = divmod(number, _FOLD)
    return hashlib.sha256(f"torch_denkf {block}".encode()).digest()[0] % _FOLD == place


class LeRobotReplay(EpisodeReplay):
    """Replay buffer of a robot's camera images and joint states in LeRobot's format.

    TorchRL's ``LeRobotExperienceReplay`` downloads from the hub and decodes videos when it samples, for
    vision-language-action models. This class reads a folder, decodes once, to the input size of a filter's sensor, and
    returns samples for a filter and its loss. Keys, samples and splits are those of
    :class:`~torch_denkf.data.EpisodeReplay`; here the readings are

    ===================== ============ ===========================================================================
    key                   shape        content
    ===================== ============ ===========================================================================
    ``pixels``            [n,3,H,W]    float32 in [0, 1], RGB; zeros if the frame is missing
    ``state``             [n,S]        float32, such as the joints' positions, in the recording's units
    ``action``            [n,A]        float32, if there are actions
    ``observed``          [n,1]        bool: the frame exists, and its row is valid
    ===================== ============ ===========================================================================

    Rows whose state or action is not finite, or whose time does not increase, keep their place and are not observed; a
    warning counts them. A state or action that is not finite is replaced by the last finite one; its row is False in
    ``state_observed`` or ``action_observed``, and is left out of losses by ``("collector", "mask")``.

    Frames are stored as uint8 in the given ``size``, memory-mapped: 37 kB for a frame of 96 x 128. All splits share an
    entry of the cache.

    Versions 2.0, 2.1 and 3.0 of the format are read, with videos or images. OpenCV decodes H.264 and others; AV1,
    LeRobot's default, needs PyAV, which comes with ``pip install 'torch_denkf[lerobot]'`` as does pyarrow for the
    parquet files. A video's frame belongs to the row nearest in time, so that a damaged frame is missing in its own row
    only.

    A hash selects one test episode from each block of five (0 to 4, 5 to 9, ...).

    **Repeated pictures.** A recorder with a higher rate than its camera writes some images twice. ``repeats="mask"``
    marks the second one as not observed: a filter that takes it for a new observation becomes overconfident. See
    :func:`torch_denkf.data.lerobot.repeats.repeated_pictures`.

    **Lag.** The image of row t may belong to the state that is recorded ``lag`` rows later (negative: earlier). With a
    ``lag``, the row of state t has the image of row t - lag, and each episode loses ``abs(lag)`` rows at an end.
    Actions stay with their states. On a robot, a filter that was trained with a positive lag predicts, from the newest
    image, the encoders ``lag`` rows ahead; with a negative lag its belief is ``abs(lag)`` rows old. See
    :func:`torch_denkf.data.lag_errors` for an estimate.

    Args:
        root: folder with ``meta`` and ``data``; or a recording from
            :func:`torch_denkf.data.lerobot.rows.recording_from_rows`, which ignores camera, keys and size.
        camera: key of the camera, such as ``"observation.images.top"`` or ``"top"``; None for the only one.
        state_key: feature of the state.
        action_key: feature of the action; None reads no actions. The default may be missing from the data set.
        size: (H, W) to scale the images to, ignoring their aspect ratio.
        dims: components of the state to keep, in this order, by index or by name, such as one arm of a robot. None for
            all.
        action_dims: components of the action to keep, by index. Commands to other joints are noise to a learned motion.
        repeats: ``"keep"`` or ``"mask"`` repeated pictures.
        lag: rows by which the states are later than the images.
        episodes: numbers of the episodes to read, by default all; only their files must exist. The selection does not
            change the splits.
        origin: offset that is subtracted from ``"state"`` and ``"action"``, a number or one for each component, in
            float64, before the conversion to float32, which has seven digits. A warning says if those are too few.
        **options: of :class:`~torch_denkf.data.EpisodeReplay`.

    Attributes:
        episodes: of this split, with the recording's own ``number``.
        fps: rows per second.
        names: names of the kept components of the state, such as the joints; None if the recording has no names.
        lag: as it was passed.
        repeats_masked: number of rows of this split that are not observed because their image is a repeat.

    Raises:
        ImportError: without pyarrow.
        FileNotFoundError: without the folder, a parquet file or a video; the message counts the missing files, and
            lists the complete episodes.
        ValueError: for unsupported versions of the format, unknown cameras, features, ``episodes`` and ``dims``, files
            that are damaged or contradict the metadata, splits without episodes, episodes that are shorter than a slice
            or the lag, and an unknown ``repeats``.

    Examples:
        >>> data = LeRobotReplay("aloha_static_coffee", camera="cam_high", slice_len=16, batch_size=64)
        ... # doctest: +SKIP
        >>> data.sample()["pixels"].shape  # doctest: +SKIP
        torch.Size([4, 16, 3, 96, 128])

        Rows that are in memory already:

        >>> from tensordict import TensorDict
        >>> from torch_denkf.data.lerobot.rows import recording_from_rows
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
        dims: Sequence[int | str] | None = None,
        action_dims: Sequence[int] | None = None,
        repeats: Literal["keep", "mask"] = "keep",
        lag: int = 0,
        episodes: Sequence[int] | None = None,
        origin: Mapping[str, float | Sequence[float]] | None = None,
        **options: Unpack[ReplayOptions],
    ):
        check_options(options)
        if repeats not in ("keep", "mask"):
            raise ValueError(f"repeats is 'keep' or 'mask', got {repeats!r}")
        if not (origin is None or isinstance(origin, Mapping)):
            raise TypeError(
                f"origin holds numbers for 'state' and 'action', such as {{'state': 5.4e6}}; got {origin!r}"
            )
        if isinstance(root, DecodedRecording):
            if episodes is not None or origin is not None:
                raise ValueError("episodes= and origin= are for folders; select and subtract in the rows instead")
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
                episodes=episodes,
                origin=origin,
            )
        self.fps, self.names, self.lag = recording.fps, recording.names, lag
        self._images = JoinedPictures([recording.rows["image"]])
        rows, self._shown = _paired(recording.rows.exclude("image"), lag)
        if dims is not None:
            kept = _places("dims", dims, recording.names, rows["state"].shape[-1])
            rows["state"] = rows["state"][:, kept]
            self.names = recording.names and tuple(recording.names[place] for place in kept)
        if action_dims is not None and "action" in rows:
            rows["action"] = rows["action"][:, _places("action_dims", action_dims, None, rows["action"].shape[-1])]
        numbers, lengths = torch.unique_consecutive(rows.pop("episode"), return_counts=True)
        starts = (lengths.cumsum(0) - lengths).tolist()
        repeated = torch.zeros(len(rows), dtype=torch.bool)
        if repeats == "mask":
            seen = torch.where(rows["observed"].squeeze(-1), self._shown, -1)
            repeated = repeated_pictures(self._images, seen, rows["step"].squeeze(-1) == 0)
            rows["observed"] = rows["observed"] & ~repeated.unsqueeze(-1)
        super().__init__(
            rows,
            [
                LeRobotEpisode(f"episode_{number:06d}", start, length, number)
                for number, start, length in zip(numbers.tolist(), starts, lengths.tolist(), strict=True)
            ],
            for_tests=lambda episode: is_for_tests(episode.number),
            pictures=partial(_pictures_of_rows, self._images, self._shown),
            root=recording.source,
            **options,
        )
        self.repeats_masked = int(repeated[self.storage[:][ROW].squeeze(-1)].sum())

    def _picture_statistics(self, index: Tensor) -> dict[str, Tensor]:
        return picture_statistics(self._images, self._shown[index[self._all_rows["observed"].squeeze(-1)[index]]])


def _paired(rows: TensorDict, lag: int) -> tuple[TensorDict, Tensor]:
    """Returns the rows with an image ``lag`` rows before, with their ``step``, and the indices of these images."""
    numbers, lengths = torch.unique_consecutive(rows["episode"], return_counts=True)
    if int(lengths.min()) <= abs(lag):
        short = numbers[lengths <= abs(lag)].tolist()
        raise ValueError(f"lag={lag} leaves nothing of the episodes {short[:10]}, which have no more rows; pass less")
    frame = rows["frame"].squeeze(-1)
    length = lengths.repeat_interleave(lengths)
    index = ((frame - lag >= 0) & (frame - lag < length)).nonzero().squeeze(-1)
    shown = index - lag
    first = index[torch.cat([torch.ones(1, dtype=torch.bool), rows["episode"][index].diff() != 0])]
    begin = first.repeat_interleave(lengths - abs(lag))
    out = rows[index].exclude("frame")
    out["step"] = rows["frame"][index] - rows["frame"][begin]
    if lag:
        out["time"] = rows["time"][index] - rows["time"][begin]
        out["observed"] = rows["observed"][shown]
    return out, shown


def _pictures_of_rows(images: JoinedPictures, shown: Tensor, row: Tensor) -> dict[str, Tensor]:
    return float_pictures(images, shown[row])


def _places(argument: str, dims: Sequence[int | str], names: tuple[str, ...] | None, width: int) -> list[int]:
    """Returns the indices of components that are given by index or name."""
    places = {name: place for place, name in enumerate(names or ())}
    chosen = [places.get(dim, -1) if isinstance(dim, str) else int(dim) for dim in dims]
    if not chosen or not all(0 <= place < width for place in chosen):
        known = f", {', '.join(names)}" if names else ""
        raise ValueError(f"{argument}={list(dims)} names none or others than the {width} numbers there are{known}")
    return chosen
