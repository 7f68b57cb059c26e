"""What torchrl environments see of a filter."""

from torch_denkf.transforms.denkf import DEnKFTransform
from torch_denkf.transforms.primer import LastAction

__all__ = [
    "DEnKFTransform",
    "LastAction",
]
