"""Detects images that a recorder wrote again because no new one had arrived."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_denkf.data.pictures import JoinedPictures

__all__ = ["REPEAT_THRESHOLD", "repeated_pictures"]

# Grey levels of 255. In a recording of a Unitree G1, encoded by H.264, repeats differ by about 0.01, other images by
# about 2, and 2 % of all differences are between 0.025 and 0.12.
REPEAT_THRESHOLD = 0.08


def repeated_pictures(
    pictures: Tensor | JoinedPictures, shown: Tensor, first: Tensor, threshold: float = REPEAT_THRESHOLD
) -> Tensor:
    """Masks rows that repeat the image of the row before.

    A recorder with a higher rate than its camera repeats images. A video codec changes a repeated image a little, so
    that repeats are not exactly equal. A repeat has no new information: a filter that takes it for a new observation
    becomes overconfident.

    Args:
        pictures: uint8 ``[M, C, H, W]``.
        shown: index of each row's image, int64 ``[N]``; negative for rows without an image, which are skipped.
        first: first rows of episodes, which are no repeats, bool ``[N]``.
        threshold: mean absolute difference in grey levels, of 255, below which an image is a repeat.

    Returns:
        bool ``[N]``.

    Examples:
        >>> pictures = torch.tensor([10, 10, 90, 90], dtype=torch.uint8).view(4, 1, 1, 1).expand(4, 3, 8, 8)
        >>> repeated_pictures(pictures, torch.arange(4), torch.arange(4) == 0)
        tensor([False,  True, False,  True])
    """
    repeated = torch.zeros(len(shown), dtype=torch.bool)
    before: np.ndarray | None = None
    for rows in torch.arange(len(shown)).split(256):
        part = pictures[shown[rows].clamp_min(0)].numpy()
        for row, picture in zip(rows.tolist(), part, strict=True):
            if first[row]:
                before = None
            if shown[row] < 0:
                continue
            flat = picture.reshape(len(picture), -1)
            repeated[row] = before is not None and cv2.mean(cv2.absdiff(flat, before))[0] < threshold
            before = flat
    return repeated
