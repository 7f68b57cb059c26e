"""An image trunk for robot arms: keypoint positions in the image, and pooled features of the whole image."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from torch_denkf._checks import check_count

__all__ = ["KeypointTrunk", "SpatialSoftArgmax"]


class SpatialSoftArgmax(nn.Module):
    """Computes the mean position of each channel under the softmax of its values.

    Args:
        channels: C.

    Shape:
        ``[N, C, H, W]`` to ``[N, 2C]``: columns, then rows, from -1 (left, top) to 1 (right, bottom).

    Reference:
        Levine, Finn, Darrell, Abbeel, "End-to-end training of deep visuomotor policies", JMLR 17, 2016, section 5.

    Example:
        >>> image = torch.zeros(1, 1, 3, 3)
        >>> image[0, 0, 0, 2] = 100.0  # the upper right corner
        >>> SpatialSoftArgmax(1)(image)
        tensor([[ 1., -1.]], grad_fn=...)
    """

    def __init__(self, channels: int):
        check_count("channels", channels)
        super().__init__()
        self.log_sharpness = nn.Parameter(torch.zeros(channels, 1))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Returns mean positions."""
        height, width = features.shape[-2:]
        place = (features.flatten(-2) * self.log_sharpness.exp()).softmax(-1).unflatten(-1, (height, width))
        columns, rows = (torch.linspace(-1, 1, n, device=place.device, dtype=place.dtype) for n in (width, height))
        return torch.cat([place.sum(-2) @ columns, place.sum(-1) @ rows], -1)


class KeypointTrunk(nn.Module):
    """Convolutions with pixel coordinates as further inputs, whose outputs are keypoint positions and averages.

    A fully connected layer over all pixels, as in Table I, must learn each position separately. Joint angles depend on
    the positions of the links, so that this trunk needs fewer demonstrations.

    Args:
        in_channels: C of the images.
        channels: channels of the convolutions, of stride 2 each, with group normalisation and ReLU.
        keypoints: number of keypoints, one channel each.
        features: width of the output.
        pooled: rows and columns of the grid over which the last map is averaged, in addition to the keypoints.

    Shape:
        ``[N, C, H, W]`` to ``[N, features]``, for any H and W from ``2 ** (len(channels) - 1)`` on.

    Example:
        >>> trunk = KeypointTrunk(3)
        >>> trunk(torch.zeros(2, 3, 112, 112)).shape
        torch.Size([2, 128])
    """

    def __init__(
        self,
        in_channels: int,
        channels: Sequence[int] = (24, 32, 48, 64, 96),
        keypoints: int = 32,
        features: int = 128,
        pooled: int = 4,
    ):
        super().__init__()
        named = {"in_channels": in_channels, "keypoints": keypoints, "features": features, "pooled": pooled}
        for name, value in named.items():
            check_count(name, value)
        for width in channels:
            check_count("channels, each,", width, least=8, cure="They are normalised in groups of eight")
        widths = [in_channels + 2, *channels]
        blocks = [
            nn.Sequential(
                nn.Conv2d(before, after, 5 if first else 3, 2, 2 if first else 1), nn.GroupNorm(8, after), nn.ReLU()
            )
            for first, before, after in zip([True] + [False] * len(channels), widths, widths[1:], strict=False)
        ]
        # Positions are read from a map of finer resolution: one block before the last.
        self.stem, self.last = nn.Sequential(*blocks[:-1]), blocks[-1]
        self.places = nn.Sequential(nn.Conv2d(widths[-2], keypoints, 1), SpatialSoftArgmax(keypoints))
        self.pool = nn.Sequential(nn.AdaptiveAvgPool2d(pooled), nn.Flatten())
        self.mix = nn.Sequential(nn.Linear(2 * keypoints + widths[-1] * pooled**2, features), nn.ReLU())

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Returns features of images."""
        height, width = images.shape[-2:]
        rows = torch.linspace(-1, 1, height, device=images.device, dtype=images.dtype)
        columns = torch.linspace(-1, 1, width, device=images.device, dtype=images.dtype)
        grid = torch.stack(torch.meshgrid(columns, rows, indexing="xy")).expand(len(images), -1, -1, -1)
        fine = self.stem(torch.cat([images, grid], 1))
        return self.mix(torch.cat([self.places(fine), self.pool(self.last(fine))], -1))
