"""Means and standard deviations of readings and of images."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.data.pictures import JoinedPictures

__all__ = ["mean_and_std", "picture_statistics"]


def mean_and_std(values: Tensor) -> dict[str, Tensor]:
    """Returns mean and standard deviation of each column of ``[n, ...]``, in double; the latter divides by n.

    Examples:
        >>> mean_and_std(torch.tensor([[1.0], [3.0]]))
        {'mean': tensor([2.], dtype=torch.float64), 'std': tensor([1.], dtype=torch.float64)}
    """
    values = values.double()
    return {"mean": values.mean(0), "std": values.std(0, correction=0)}


def picture_statistics(pictures: Tensor | JoinedPictures, index: Tensor, chunk: int = 256) -> dict[str, Tensor]:
    """Returns mean and standard deviation of each channel, ``[C, 1, 1]``, of values in [0, 1].

    Args:
        pictures: uint8 ``[N, C, H, W]``, maybe memory-mapped.
        index: indices of the images, ``[n]``.
        chunk: images that are read together.
    """
    counts = torch.zeros(pictures.shape[1], 256, dtype=torch.float64)  # histogram of each channel, for exact statistics
    for part in index.split(chunk):
        for channel, values in enumerate(pictures[part].unbind(1)):
            counts[channel] += torch.bincount(values.reshape(-1), minlength=256)
    value = torch.arange(256, dtype=torch.float64) / 255
    share = counts / counts.sum(-1, keepdim=True).clamp_min(1)
    mean = share @ value
    std = (share * (value - mean[:, None]).square()).sum(-1).sqrt()
    return {"mean": mean[:, None, None], "std": std[:, None, None]}
