"""Training objectives as torchrl loss modules: for whole filters, and for single parts."""

from torch_denkf.objectives.filter_loss import Term
from torch_denkf.objectives.parts import ObservationLoss, SensorLoss, TransitionLoss
from torch_denkf.objectives.whole import DEnKFLoss, GaussianLoss, MixtureLoss

__all__ = [
    "DEnKFLoss",
    "GaussianLoss",
    "MixtureLoss",
    "ObservationLoss",
    "SensorLoss",
    "Term",
    "TransitionLoss",
]
