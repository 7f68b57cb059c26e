"""Training objectives, torchrl loss modules."""

from torch_denkf.objectives.denkf import DEnKFLoss
from torch_denkf.objectives.gaussian import GaussianLoss

__all__ = ["DEnKFLoss", "GaussianLoss"]
