"""Samples of slices: their sampler, and their shape ``[B, T]``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torchrl.data import SliceSampler
from torchrl.data.replay_buffers.sample_units import SampleUnit
from torchrl.data.replay_buffers.samplers import Sampler

from torch_denkf.data.episodes import Episode

__all__ = ["Slices", "check_episode_lengths", "choose_sampler", "slices_of"]


def choose_sampler(options: Mapping[str, Any]) -> tuple[Sampler | None, int | None]:
    """Returns the sampler of a data set's options, of slices if they are requested, and the batch size.

    Raises:
        ValueError: if ``sampler`` comes with ``num_slices`` or ``slice_len``, or these two contradict ``batch_size``.

    Examples:
        >>> sampler, batch_size = choose_sampler({"num_slices": 4, "slice_len": 16})
        >>> sampler.slice_len, batch_size
        (16, 64)
    """
    names = ("sampler", "num_slices", "slice_len", "batch_size")
    sampler, num_slices, slice_len, batch_size = map(options.get, names)
    if num_slices is None and slice_len is None:
        return sampler, batch_size
    if sampler is not None:
        raise ValueError("pass either a sampler, which may cut slices itself, or num_slices and slice_len")
    if num_slices is not None and slice_len is not None:
        rows = num_slices * slice_len
        if batch_size not in (None, rows):
            raise ValueError(
                f"num_slices={num_slices} times slice_len={slice_len} is {rows} rows, but batch_size={batch_size}; "
                "leave one of the three out"
            )
        num_slices, batch_size = None, rows
    strict = options.get("strict_length", True)
    kept = {"traj_key": "episode", "cache_values": True, "strict_length": strict}
    return SliceSampler(num_slices=num_slices, slice_len=slice_len, **kept), batch_size


def slices_of(sampler: Sampler | None) -> Slices | None:
    """Returns the unit that shapes samples as ``[B, T]``; None unless the sampler's slices have equal lengths."""
    if not isinstance(sampler, SliceSampler) or any(sampler.span):
        return None
    return Slices(sampler) if sampler.strict_length or sampler.pad_output else None


class Slices(SampleUnit):
    """Shapes the rows of a sample ``[B * T]`` as slices ``[B, T]``, before the storage is read.

    Args:
        sampler: draws slices of equal lengths.
    """

    def __init__(self, sampler: SliceSampler):
        self._sampler = sampler

    def expand(self, index: Any, info: dict[str, Any], storage: Any) -> tuple[Any, dict[str, Any]]:
        """Reshapes rows, and the sampler's information about them, to slices."""
        first = index[0] if isinstance(index, tuple) else index
        rows = len(first)
        ends = info.get(self._sampler.truncated_key)  # without replacement, the last sample may have fewer slices
        count = self._sampler.num_slices or rows // self._sampler.slice_len
        shape = (count if ends is None else int(ends.sum()), -1)

        def shaped(value: Any) -> Any:
            # Weights of prioritised samplers may be arrays; values that are not per row are unchanged.
            if getattr(value, "ndim", 0) and len(value) == rows:
                return torch.as_tensor(value).reshape(*shape, *value.shape[1:])
            return value

        index = tuple(map(shaped, index)) if isinstance(index, tuple) else shaped(index)
        return index, {key: shaped(value) for key, value in info.items()}


def check_episode_lengths(episodes: Sequence[Episode], sampler: Sampler | None, batch_size: int | None) -> None:
    """Checks that no episode is too short; TorchRL's samplers would skip it without a warning.

    Raises:
        ValueError: if an episode is shorter than a slice.
    """
    if not isinstance(sampler, SliceSampler) or not sampler.strict_length:
        return
    length = sampler.slice_len
    if length is None:
        length = None if batch_size is None else batch_size // sampler.num_slices
    short = {episode.name: episode.length for episode in episodes if length is not None and episode.length < length}
    if short:
        some = dict(list(short.items())[:8])
        raise ValueError(
            f"slices have {length} rows, but {len(short)} episodes are shorter: {some}; pass shorter slices, leave the "
            "episodes out, or pass strict_length=False for slices that may be shorter"
        )
