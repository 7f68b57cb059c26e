"""What the data sets share: episodes one behind the other, cut into slices, with pixels that are made when sampled."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, SliceSampler, TensorStorage
from torchrl.data.datasets.common import BaseDatasetExperienceReplay
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.writers import Writer
from torchrl.envs.transforms import Transform


def choose_sampler(
    sampler: Sampler | None, num_slices: int | None, slice_len: int | None, strict_length: bool
) -> Sampler | None:
    """A sampler of slices of episodes, if they are asked for, or else the one that was passed.

    Raises:
        ValueError: if more than one of ``sampler``, ``num_slices`` and ``slice_len`` is passed.
    """
    if num_slices is None and slice_len is None:
        return sampler
    if sampler is not None or (num_slices is not None and slice_len is not None):
        raise ValueError("pass one of num_slices, slice_len and sampler; the sampler may cut slices itself")
    return SliceSampler(
        num_slices=num_slices, slice_len=slice_len, traj_key="episode", cache_values=True, strict_length=strict_length
    )


def episode_flags(first: Tensor, last: Tensor) -> dict[str, Any]:
    """Flags of rows: ``is_init`` where ``first``, truncated and done where ``last``, never terminated; no done at root.

    Args:
        first: bool ``[n, 1]``: the row begins an episode.
        last: bool ``[n, 1]``: it ends one.

    Examples:
        >>> row = torch.arange(3).unsqueeze(-1)
        >>> flags = episode_flags(row == 0, row == 2)
        >>> flags["is_init"].flatten(), flags["next"]["truncated"].flatten(), flags["done"].any()
        (tensor([ True, False, False]), tensor([False, False,  True]), tensor(False))
    """
    never = torch.zeros_like(first)
    done = {"done": last, "truncated": last.clone(), "terminated": never.clone()}
    return {"is_init": first, **{key: never.clone() for key in done}, "next": TensorDict(done, first.shape[:1])}


def whole_episode(count: int) -> dict[str, Any]:
    """Flags of the rows of one episode, see :func:`episode_flags`."""
    row = torch.arange(count).unsqueeze(-1)
    return episode_flags(row == 0, row == count - 1)


class EpisodeReplay(BaseDatasetExperienceReplay):
    """A read-only replay buffer of episodes that lie one behind the other.

    A subclass sets ``root`` before it calls the constructor, and writes ``_is_downloaded``, ``_say_short`` and
    ``_not_ours``.

    Args:
        rows: what is stored, ``[n]``, with ``"episode"``.
        episodes: what these rows are, each with a ``length``.
        frames: adds to sampled rows what is not stored in them.
        sampler: see :func:`choose_sampler`.
        batch_size: rows of a sample.
        writer: by default one that refuses to write.
        transform: applied to each sample after ``frames``.
        **kwargs: of torchrl's buffers.

    Raises:
        ValueError: if episodes are shorter than the sampler's slices.
    """

    def __init__(
        self,
        rows: TensorDictBase,
        episodes: Sequence[Any],
        frames: Transform,
        *,
        sampler: Sampler | None,
        batch_size: int | None,
        writer: Writer | None,
        transform: Transform | Callable | None,
        **kwargs,
    ):
        self.episodes = tuple(episodes)
        self._check_lengths(sampler, batch_size)
        self._frames = frames
        super().__init__(
            storage=TensorStorage(rows),
            sampler=sampler,
            writer=ImmutableDatasetWriter() if writer is None else writer,
            batch_size=batch_size,
            transform=frames,
            **kwargs,
        )
        if transform is not None:
            self.append_transform(transform)

    def _check_lengths(self, sampler: Sampler | None, batch_size: int | None) -> None:
        """TorchRL's samplers leave short episodes out without a word; here, that is a mistake."""
        if not isinstance(sampler, SliceSampler) or not sampler.strict_length:
            return
        length = sampler.slice_len
        if length is None:
            length = None if batch_size is None else batch_size // sampler.num_slices
        short = [episode for episode in self.episodes if length is not None and episode.length < length]
        if short:
            raise ValueError(
                f"slices have {length} rows, but {self._say_short(short)} pass shorter slices, or strict_length=False "
                "for slices that may be shorter"
            )

    def _say_short(self, short: Sequence[Any]) -> str:
        """Which episodes are shorter than a slice, for a message, up to what to do about it."""
        raise NotImplementedError

    @property
    def _not_ours(self) -> str:
        """Why the data set does not delete its files, for a message."""
        raise NotImplementedError

    @property
    def data_path(self) -> Path | None:
        """The folder that the data set reads; None for one that came from elsewhere."""
        return self.root

    @property
    def data_path_root(self) -> Path | None:
        """The same: splits are no folders."""
        return self.root

    def delete(self) -> None:
        """Refuses: what the data set reads is not its own.

        Raises:
            RuntimeError: always.
        """
        raise RuntimeError(self._not_ours)

    def preprocess(self, fn: Callable[[TensorDictBase], TensorDictBase], *args, **kwargs) -> TensorStorage:
        """TorchRL's ``preprocess``: ``fn`` sees rows with their pixels, and what it returns is stored in ``dest``."""
        return super().preprocess(partial(_then, self._frames, fn), *args, **kwargs)


def _then(first: Transform, fn: Callable, rows: TensorDictBase) -> TensorDictBase:
    return fn(first(rows))
