"""The trunk of the main sensor: keypoints of the whole picture, and a second look at the hand."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, grid_sample

from torch_denkf.modules import KeypointTrunk

REACH = 0.34  # half a patch's side, in half widths of the picture: hand and wrist


class Shrink(nn.Module):
    """Pictures of half the size."""

    def forward(self, images: Tensor) -> Tensor:
        """``[N, 3, H / 2, W / 2]``."""
        return avg_pool2d(images, 2)


class HalfKeypointTrunk(KeypointTrunk):
    """The same with convolutions of 16 bits: half the time on a processor that has them. Places keep 32 bits."""

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
        self.close = nn.Sequential(
            *_block(5, 32, 5, 2), *_block(32, 48, 3, 2), *_block(48, 64, 3, 1), *_block(64, 96, 3, 2), nn.Flatten()
        )
        patch = 8 * max(round(REACH * width / 8), 1)  # about a pixel of the picture each
        self.squeeze = nn.Sequential(nn.Dropout(0.2), nn.Linear(96 * (patch // 8) ** 2, 192), nn.ReLU())
        self.mix = nn.Sequential(nn.Dropout(0.1), nn.Linear(size + 192 + 2, features - 2), nn.ReLU())
        side = torch.linspace(-1, 1, patch)
        self.register_buffer("grid", torch.stack(torch.meshgrid(side, side, indexing="xy"), -1), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        """Features of images."""
        code = self.coarse(avg_pool2d(images, 2))
        centre = self.centre(code)
        aspect = images.shape[-1] / images.shape[-2]
        way = REACH * self.grid * self.grid.new_tensor([1.0, aspect])
        # What the patch shows teaches where to look no better than the place itself does.
        grid = centre.detach()[:, None, None] + way
        patch = grid_sample(images.contiguous(), grid, align_corners=False, padding_mode="border")
        patch = torch.cat([patch, self.grid.permute(2, 0, 1).expand(len(images), -1, -1, -1)], 1)
        with torch.autocast("cpu", dtype=torch.bfloat16):
            close = self.close(patch)
        mixed = self.mix(torch.cat([code, self.squeeze(close.float()), centre], -1))
        return torch.cat([mixed, centre], -1)


def _block(before: int, after: int, side: int, stride: int) -> tuple[nn.Module, ...]:
    return nn.Conv2d(before, after, side, stride, side // 2), nn.GroupNorm(8, after), nn.ReLU()
