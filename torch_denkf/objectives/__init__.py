"""Training objectives, torchrl loss modules."""

from torch_denkf.objectives.denkf import DEnKFLoss
from torch_denkf.objectives.gaussian import GaussianLoss
from torch_denkf.objectives.mixture import MixtureLoss

__all__ = ["DEnKFLoss", "GaussianLoss", "MixtureLoss"]
