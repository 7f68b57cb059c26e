"""The trunk of the main sensor: keypoints of the whole picture, and a second look at the hand."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d

from benchmarks.common.arm.close_look import FEATURES, CloseLook
from torch_denkf.modules import KeypointTrunk

REACH = 0.34  # half a patch's side, in half widths of the picture: hand and wrist


class HalfKeypointTrunk(KeypointTrunk):
    """Keypoints with convolutions of 16 bits: half the time on a processor that has them. Places keep 32 bits."""

    def forward(self, images: Tensor) -> Tensor:
        """Features of images."""
        height, width = images.shape[-2:]
        rows, columns = torch.linspace(-1, 1, height), torch.linspace(-1, 1, width)
        grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy")).expand(len(images), -1, -1, -1)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            fine = self.stem(torch.cat([images, grid], 1))
            last = self.last(fine)
        return self.mix(torch.cat([self.places(fine.float()), self.pool(last.float())], -1))


class SecondLookTrunk(nn.Module):
    """Looks at the whole picture at half the resolution, and at the hand closely.

    The last two features are where it looks: columns and rows from -1 (left, top) to 1. Train them to be the hand.

    Args:
        width: of the picture in pixels.
        size: features of the first look.
        features: of the output, those two among them.

    Shape:
        ``[N, 3, H, W]`` to ``[N, features]``.
    """

    def __init__(self, width: int, size: int = 192, features: int = 256):
        super().__init__()
        self.coarse = HalfKeypointTrunk(3, channels=(32, 48, 96, 128), keypoints=64, features=size)
        self.centre = nn.Linear(size, 2)
        self.close = CloseLook(width, REACH, dropout=0.2, half=True)
        self.mix = nn.Sequential(nn.Dropout(0.1), nn.Linear(size + FEATURES + 2, features - 2), nn.ReLU())

    def forward(self, images: Tensor) -> Tensor:
        """Features of images."""
        code = self.coarse(avg_pool2d(images, 2))
        centre = self.centre(code)
        # What the patch shows teaches where to look no better than the place itself does.
        mixed = self.mix(torch.cat([code, self.close(images, centre.detach()), centre], -1))
        return torch.cat([mixed, centre], -1)
