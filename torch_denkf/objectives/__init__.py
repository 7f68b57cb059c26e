"""Training objectives, torchrl loss modules: of whole filters, and of their parts alone."""

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
