"""What torchrl environments see of a filter, and what disturbs its frames."""

from torch_denkf.transforms.denkf import DEnKFTransform
from torch_denkf.transforms.missing import MissingFrames

__all__ = ["DEnKFTransform", "MissingFrames"]
