"""A network that looks at a patch of an image at full resolution."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn.functional import grid_sample

FEATURES = 192  # of a patch


class CloseLook(nn.Module):
    """Maps a patch of an image at full resolution to features, for objects that are a dozen pixels wide.

    The patch costs as much as the whole image at a third of its resolution.

    Args:
        picture: width of the image in pixels.
        reach: half a patch's side, in half images.
        dropout: in front of the last layer; 0 for none.
        half: whether convolutions have 16 bits, which takes half the time on a processor that supports them.
    """

    def __init__(self, picture: int, reach: float, dropout: float = 0.0, half: bool = False):
        super().__init__()
        self.reach, self.half = reach, half
        self.close = nn.Sequential(
            *_block(5, 32, 5, 2), *_block(32, 48, 3, 2), *_block(48, 64, 3, 1), *_block(64, 96, 3, 2), nn.Flatten()
        )
        patch = 8 * max(round(reach * picture / 8), 1)  # about one pixel of the image for each of the patch
        self.squeeze = nn.Sequential(nn.Linear(96 * (patch // 8) ** 2, FEATURES), nn.ReLU())
        self.dropout = nn.Dropout(dropout)
        side = torch.linspace(-1, 1, patch)
        self.register_buffer("grid", torch.stack(torch.meshgrid(side, side, indexing="xy"), -1), persistent=False)

    def forward(self, images: Tensor, centre: Tensor, raised: float = 0.0) -> Tensor:
        """Returns features ``[N, 192]`` of images ``[N, 3, H, W]`` around places ``[N, 2]`` from -1 (left, top) to 1.

        Args:
            images: at full resolution.
            centre: columns and rows.
            raised: distance of the patch's middle above them.
        """
        aspect = images.shape[-1] / images.shape[-2]
        way = self.reach * self.grid * self.grid.new_tensor([1.0, aspect])
        grid = centre[:, None, None] + way - self.grid.new_tensor([0.0, raised])
        patch = grid_sample(images.contiguous(), grid, align_corners=False, padding_mode="border")
        patch = torch.cat([patch, self.grid.permute(2, 0, 1).expand(len(images), -1, -1, -1)], 1)
        with torch.autocast("cpu", dtype=torch.bfloat16, enabled=self.half):
            close = self.close(patch)
        return self.squeeze(self.dropout(close.float()))


class GlimpseTrunk(nn.Module):
    """Trunk that sees the whole image, and a patch around the hand, which is a dozen pixels wide.

    Args:
        coarse: maps the whole image, ``[N, 3, H, W]`` to ``[N, F]``.
        close: maps the patch to features.
        size: F.
        raised: distance of the patch's middle above the hand's place.
        dropout: in front of the last layer.
        told: whether the last two features are the patch's place, columns and rows from -1 (left, top) to 1. Train them
            to be the hand's place: no gradient reaches them through the patch.
    """

    def __init__(
        self, coarse: nn.Module, close: CloseLook, size: int, raised: float = 0.0, dropout: float = 0.0, told=False
    ):
        super().__init__()
        self.coarse, self.centre, self.close = coarse, nn.Linear(size, 2), close
        width = 254 if told else 256
        self.mix = nn.Sequential(nn.Dropout(dropout), nn.Linear(size + FEATURES + 2, width), nn.ReLU())
        self.raised, self.told = raised, told

    def forward(self, images: Tensor) -> Tensor:
        """Returns features ``[N, 256]`` of images."""
        code = self.coarse(images)
        centre = self.centre(code)
        patch = self.close(images, centre.detach() if self.told else centre, self.raised)
        mixed = self.mix(torch.cat([code, patch, centre], -1))
        return torch.cat([mixed, centre], -1) if self.told else mixed


def _block(before: int, after: int, side: int, stride: int) -> tuple[nn.Module, ...]:
    return nn.Conv2d(before, after, side, stride, side // 2), nn.GroupNorm(8, after), nn.ReLU()
