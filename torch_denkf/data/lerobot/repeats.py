"""Pictures that a recording shows again because no new one had arrived when the row was written."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_denkf.data.pictures import JoinedPictures

__all__ = ["REPEAT_THRESHOLD", "repeated_pictures"]

# Grey levels of 255. Measured on a Unitree G1's recording, encoded again by H.264: repeats differ by some 0.01, other
# pictures by some 2, and 2 % of all lie between 0.025 and 0.12.
REPEAT_THRESHOLD = 0.08


def repeated_pictures(
    pictures: Tensor | JoinedPictures, shown: Tensor, first: Tensor, threshold: float = REPEAT_THRESHOLD
) -> Tensor:
    """Masks rows that repeat the picture of the row before.

    A recorder that writes more rows than its camera takes pictures repeats some. A video's codec changes a repeated
    picture a little, so that not only equal ones count. A repeat carries no news: a filter that takes it for a second
    look becomes too sure of itself.

    Args:
        pictures: uint8 ``[M, C, H, W]``.
        shown: numbers of the rows' pictures, int64 ``[N]``; negative for rows without a picture, which are skipped.
        first: bool ``[N]``: the row begins an episode, and repeats nothing.
        threshold: mean absolute difference in grey levels, of 255, below which a picture is a repeat.

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
