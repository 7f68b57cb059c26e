"""The rows that a data set of demos samples from: which demos they are of, where these begin, and their pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs.transforms import Transform

from torch_denkf.data.replay import episode_flags
from torch_denkf.data.ur5.files import Entry
from torch_denkf.simulation.ur5.names import TASKS


@dataclass(frozen=True)
class UR5Episode:
    """One demo.

    Attributes:
        demo: its number in the collection.
        task: ``"pick"``, ``"push"`` or ``"put_down"``.
        start: its first row in the data set.
        length: its rows; they follow each other in time, unless only frames are read.
    """

    demo: int
    task: str
    start: int
    length: int


def split_of(demo: int) -> str:
    """``"test"`` for a fifth of all numbers, ``"train"`` for the others, by a hash: no option moves a demo."""
    digest = hashlib.sha256(f"ur5 demo {demo}".encode()).digest()
    return "test" if int.from_bytes(digest[:8], "big") % 5 == 0 else "train"


def episode_rows(
    rows: TensorDictBase, entries: Sequence[Entry], chosen: Sequence[bool], frames_only: bool
) -> tuple[TensorDict, tuple[UR5Episode, ...]]:
    """Rows of the chosen demos with the flags and numbers of episodes, and what these numbers stand for.

    Args:
        rows: of all demos, see :func:`torch_denkf.data.ur5.cache.read_demos`.
        entries: of all demos.
        chosen: which of them to take.
        frames_only: True for the rows with a picture, each on its own.
    """
    take = torch.tensor(chosen)
    counts = torch.tensor([entry.rows for entry in entries])
    first_rows = (counts.cumsum(0) - counts)[take].tolist()
    number = torch.arange(len(entries)).repeat_interleave(counts)
    keep = take[number]
    if frames_only:
        keep = keep & (rows["frame"].squeeze(-1) >= 0)
    episode = (take.cumsum(0) - 1)[number[keep]]
    first = torch.zeros(len(episode), 1, dtype=torch.bool)
    last = first.clone()
    changes = episode.diff() != 0
    first[1:, 0], last[:-1, 0] = changes, changes
    first[:1] = last[-1:] = True
    if frames_only:
        first[:] = last[:] = True
    selected = {key: value[keep] for key, value in rows.items()}
    out = TensorDict({**selected, "episode": episode, **episode_flags(first, last)}, episode.shape)
    lengths = torch.bincount(episode, minlength=int(take.sum()))
    starts = (lengths.cumsum(0) - lengths).tolist()
    demos = [entry.demo for entry, use in zip(entries, chosen, strict=True) if use]
    tasks = [TASKS[task] for task in rows["task"][first_rows].flatten().tolist()]
    return out, tuple(map(UR5Episode, demos, tasks, starts, lengths.tolist()))


class SampledPixels(Transform):
    """Adds pixels and what was observed to rows of the buffer, from the memory-mapped pictures.

    Args:
        pixels: uint8 ``[F, 3, H, W]``, or None if there are none.
    """

    def __init__(self, pixels: Tensor | None):
        super().__init__()
        self._stored = pixels

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replaces ``"frame"`` by ``"observed"`` and ``"pixels"``."""
        tensordict = tensordict.copy()  # data[:] hands out the storage itself
        frame = tensordict.pop("frame")
        observed = frame >= 0
        tensordict["observed"] = observed
        if self._stored is not None:
            at = observed.reshape(-1)
            pixels = torch.zeros(len(at), *self._stored.shape[1:], dtype=torch.float32)
            pixels[at] = self._stored[frame.reshape(-1)[at]].to(torch.float32) / 255
            tensordict["pixels"] = pixels.reshape(*tensordict.batch_size, *pixels.shape[1:])
        return tensordict
