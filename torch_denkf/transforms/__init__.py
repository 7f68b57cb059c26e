"""What torchrl environments see of a filter."""

from torch_denkf.filters.primer import LastAction
from torch_denkf.transforms.denkf import DEnKFTransform

__all__ = [
    "DEnKFTransform",
    "LastAction",
]
