"""Masks images that are entirely black."""

from __future__ import annotations

from tensordict import NestedKey
from torch import Tensor, nn

from torch_denkf._checks import check_number
from torch_denkf.modules.tensors import mask_of
from torch_denkf.submodel import Sensor

__all__ = ["BlackIsMissing"]


class BlackIsMissing(Sensor):
    """Marks images that are entirely black as not observed.

    A network outputs a reading for a black image, too, and the filter would use it. Put this module in front of the
    sensor, ``TensorDictSequential(BlackIsMissing(), sensor)``, and let the filter read its mask,
    ``observed_key="seen"``. The filter then only predicts until the camera is back, and its spread grows.

    Args:
        threshold: an image is black if no pixel is brighter than this share of white.
        image_key: images ``[*B, C, H, W]``, in [0, 1] or integers up to 255.
        observed_key: optional observed mask ``[*B, 1]`` of the images.
        out_key: the mask ``[*B, 1]``: False where an image is black, or ``observed_key`` is False.

    Raises:
        ValueError: if the threshold is not between 0 and 1, or both masks have one key.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> pictures = torch.stack([torch.zeros(3, 4, 4), torch.full((3, 4, 4), 0.3)])
        >>> BlackIsMissing()(TensorDict({"pixels": pictures}, [2]))["seen"].tolist()
        [[False], [True]]
    """

    def __init__(
        self,
        threshold: float = 0.02,
        *,
        image_key: NestedKey = "pixels",
        observed_key: NestedKey = "observed",
        out_key: NestedKey = "seen",
    ):
        check_number("threshold", threshold, least=0, most=1)
        super().__init__(nn.Identity(), [image_key], [out_key], optional_keys=[observed_key])
        self.threshold, self.marks = threshold, mask_of(observed_key, out_key)

    def compute(self, pixels: Tensor, before: Tensor | None = None) -> Tensor:
        """Returns the mask ``[*B, 1]``."""
        white = 1.0 if pixels.is_floating_point() else 255
        seen = (pixels.flatten(-3).amax(-1, keepdim=True) / white) > self.threshold
        return seen if before is None else seen & before
