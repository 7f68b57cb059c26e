"""Conversion of rows of torchrl's robot data sets into a recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import ReplayBuffer

from torch_denkf._checks import check_number
from torch_denkf.data.lerobot.masking import mask_invalid_rows
from torch_denkf.data.lerobot.recording import DecodedRecording, look_for_actions
from torch_denkf.data.pictures import image_store, scaled

__all__ = ["recording_from_rows"]

_CHUNK = 256  # rows of images that are read at a time


def recording_from_rows(
    rows: TensorDictBase | ReplayBuffer,
    *,
    fps: float,
    pixels_key: NestedKey = ("observation", "image"),
    state_key: NestedKey | list[NestedKey] = ("observation", "state"),
    action_key: NestedKey | list[NestedKey] | None = "action",
    episode_key: NestedKey = "episode",
    size: tuple[int, int] | None = None,
    names: tuple[str, ...] | None = None,
    folder: str | Path | None = None,
) -> DecodedRecording:
    """Turns rows as :class:`torchrl.data.datasets.OpenXExperienceReplay` stores them into a recording.

    The defaults are the keys of most of the Open X-Embodiment sets, and of
    :class:`torchrl.data.datasets.LeRobotExperienceReplay`. Berkeley's UR5 set has others::

        data = OpenXExperienceReplay("berkeley_autolab_ur5", download=True, streaming=False)
        actions = ["world_vector", "rotation_delta", "gripper_closedness_action"]
        recording = recording_from_rows(
            data,
            fps=5,
            state_key=("observation", "robot_state"),
            action_key=[("action", name) for name in actions],
            size=(96, 128),
        )
        replay = LeRobotReplay(recording, batch_size=64, slice_len=16)

    Args:
        rows: batch size ``[N]``, the rows of an episode consecutive; or a replay buffer of such rows, which is read in
            chunks and keeps its sampler.
        fps: rows per second.
        pixels_key: images, ``[N, 3, H, W]`` or ``[N, H, W, 3]``, uint8, or floating in [0, 1]; or a tensordict with one
            camera.
        state_key: state vector, ``[N, S]`` or ``[N]``; the entries of a list of keys are concatenated.
        action_key: action vector, ``[N, A]`` or ``[N]``, or a list of keys. None reads no actions; the default key may
            be missing from the rows.
        episode_key: number of each row's episode; different episodes have different numbers.
        size: (H, W) to scale the images to. None keeps their size: uint8 images of a tensordict are then not copied,
            and memory-mapped ones stay memory-mapped.
        names: names of the state's components.
        folder: folder for a temporary file of copied images; None keeps them in memory.

    Returns:
        The recording, which :class:`torch_denkf.data.LeRobotReplay` takes instead of a folder. Times start at 0 in
        each episode.

    Raises:
        TypeError: for streamed data, and images that are references to videos.
        KeyError: for missing keys.
        ValueError: for shapes other than those above, and episodes whose rows are not consecutive.

    Examples:
        >>> rows = TensorDict(
        ...     {
        ...         "observation": {"image": torch.zeros(6, 8, 8, 3, dtype=torch.uint8), "state": torch.rand(6, 4)},
        ...         "episode": torch.tensor([0, 0, 0, 1, 1, 1]),
        ...     },
        ...     batch_size=[6],
        ... )
        >>> recording_from_rows(rows, fps=5.0).rows["time"].flatten()
        tensor([0.0000, 0.2000, 0.4000, 0.0000, 0.2000, 0.4000], dtype=torch.float64)
    """
    try:
        count = len(rows)
    except RuntimeError as error:
        raise TypeError(
            "streamed data has no rows to index; open it with download=True, streaming=False, or pass a tensordict"
        ) from error
    if not count:
        raise ValueError("there are no rows for a recording")
    check_number("fps", fps, above=0, cure="It is the number of rows per second")
    stretches = [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]
    whole = size is None and isinstance(rows, TensorDictBase)
    image = _images(rows, pixels_key) if whole else None
    keep = image is not None and image.dtype == torch.uint8
    if action_key == "action" and "action" not in rows[:1]:
        look_for_actions(map(str, rows[:1].keys()), "the rows")
    store: np.ndarray | None = None
    numbers: list[TensorDict] = []
    for at in stretches:
        part = rows[at]
        episode = _get(part, episode_key).reshape(-1)
        if episode.is_floating_point() and not bool(episode.isfinite().all()):
            raise ValueError(f"{episode_key!r} numbers the episodes; it has NaN or infinity in rows {at.start} on")
        entries = {"state": _numbers(part, state_key), "episode": episode.long()}
        if action_key is not None and not (action_key == "action" and "action" not in part):
            entries["action"] = _numbers(part, action_key)
        numbers.append(TensorDict(entries, batch_size=[at.stop - at.start]))
        if keep:
            continue
        pictures = _images(part, pixels_key)
        if pictures.dtype.is_floating_point:
            pictures = (pictures * 255).round().clamp(0, 255).to(torch.uint8)
        arrays = pictures.permute(0, 2, 3, 1).numpy()
        if store is None:
            height, width = arrays.shape[1:3] if size is None else size
            store = image_store(count, (height, width), None if folder is None else Path(folder).expanduser())
        for row, picture in zip(range(at.start, at.stop), arrays, strict=True):
            store[row] = scaled(np.ascontiguousarray(picture), store.shape[2:])
    out: TensorDict = torch.cat(numbers)
    frame = _count_from_start(out["episode"], episode_key)
    out.update(
        {
            "image": image if keep else torch.from_numpy(store),
            "observed": torch.ones(count, 1, dtype=torch.bool),
            "time": frame.double() / fps,
            "frame": frame,
        }
    )
    return DecodedRecording(mask_invalid_rows(out, None, "the rows"), float(fps), names)


def _get(rows: TensorDictBase, key: NestedKey) -> Tensor | TensorDictBase:
    value = rows.get(key, None)
    if value is None:
        raise KeyError(f"the rows lack {_text(key)}; they have {', '.join(sorted(map(_text, rows.keys(True, True))))}")
    return value


def _text(key: NestedKey) -> str:
    return key if isinstance(key, str) else "/".join(key)


def _numbers(rows: TensorDictBase, keys: NestedKey | list[NestedKey]) -> Tensor:
    parts = []
    for key in keys if isinstance(keys, list) else [keys]:
        value = _get(rows, key)
        if not isinstance(value, Tensor) or value.ndim > 2:
            found = f"shape {tuple(value.shape)}" if isinstance(value, Tensor) else "several entries: pass a list"
            raise ValueError(f"{_text(key)} must be numbers [N, n], it has {found}")
        parts.append(value.reshape(len(rows), -1).float())
    return torch.cat(parts, -1)


def _images(rows: TensorDictBase, key: NestedKey) -> Tensor:
    value = _get(rows, key)
    if isinstance(value, TensorDictBase) and len(list(value.keys())):  # text entries are tensordicts without keys
        cameras = list(value.keys())
        if len(cameras) != 1:
            raise KeyError(f"{_text(key)} has the cameras {', '.join(cameras)}; pass pixels_key= of one of them")
        value = value.get(cameras[0])
    if not isinstance(value, Tensor):
        raise TypeError(
            f"{_text(key)} holds {type(value).__name__}, not images; decode them first, or pass the data set's "
            "folder to LeRobotReplay"
        )
    if value.ndim == 4 and (value.dtype == torch.uint8 or value.dtype.is_floating_point):
        if value.shape[1] == 3:
            return value
        if value.shape[-1] == 3:
            return value.permute(0, 3, 1, 2)
    raise ValueError(
        f"{_text(key)} must be [N, 3, H, W] or [N, H, W, 3], uint8 or floating, got {value.dtype} {tuple(value.shape)}"
    )


def _count_from_start(episode: Tensor, key: NestedKey) -> Tensor:
    """Returns the index of each row within its episode, ``[N, 1]``."""
    names, lengths = torch.unique_consecutive(episode, return_counts=True)
    if len(names.unique()) < len(names):
        torn = names[(names[:, None] == names).sum(1) > 1].unique().tolist()
        raise ValueError(f"by {_text(key)}, the rows of these episodes are not consecutive: {torn[:10]}; sort them")
    starts = lengths.cumsum(0) - lengths
    return (torch.arange(len(episode)) - starts.repeat_interleave(lengths)).unsqueeze(-1)
