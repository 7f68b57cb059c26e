"""Transforms of torchrl that run a filter in an environment."""

from torch_denkf.transforms.denkf import DEnKFTransform
from torch_denkf.transforms.primer import LastAction

__all__ = ["DEnKFTransform", "LastAction"]
