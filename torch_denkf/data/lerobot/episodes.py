"""Episodes of a recording: which are for tests, and the rows that a replay buffer stores of one."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf.data.replay import whole_episode

_FOLD = 5  # one episode of so many is for tests


@dataclass(frozen=True)
class RecordedEpisode:
    """One episode of a recording.

    Attributes:
        number: the recording's own.
        start: its first row in the data set.
        length: its rows; they follow each other in time.
    """

    number: int
    start: int
    length: int


def is_for_tests(number: int) -> bool:
    """Whether an episode is the one of its five that is for tests; it does not depend on the others."""
    block, place = divmod(number, _FOLD)
    return hashlib.sha256(f"torch_denkf {block}".encode()).digest()[0] % _FOLD == place


def episode_rows(recording: TensorDictBase, begin: int, count: int) -> TensorDict:
    """What the buffer stores of an episode."""
    numbers = recording.exclude("image")[begin : begin + count].clone()
    return numbers.update(whole_episode(count))


def pixel_statistics(images: Tensor, index: Tensor, chunk: int = 256) -> dict[str, Tensor]:
    """Mean and standard deviation of each colour over the images ``index``, ``[3, 1, 1]``, of values in [0, 1]."""
    counts = torch.zeros(3, 256, dtype=torch.float64)  # how often each value is there, which is exact
    for part in index.split(chunk):
        for channel, values in enumerate(images[part].unbind(1)):
            counts[channel] += torch.bincount(values.reshape(-1), minlength=256)
    value = torch.arange(256, dtype=torch.float64) / 255
    share = counts / counts.sum(-1, keepdim=True).clamp_min(1)
    mean = share @ value
    std = (share * (value - mean[:, None]).square()).sum(-1).sqrt()
    return {"mean": mean[:, None, None], "std": std[:, None, None]}
