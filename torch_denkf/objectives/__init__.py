"""Training objectives, torchrl loss modules."""

from torch_denkf.objectives.denkf import DEnKFLoss

__all__ = ["DEnKFLoss"]
