"""Training objectives, torchrl loss modules: of whole filters, and of their parts alone."""

from torch_denkf.objectives._options import ReadingsOptions, SequenceOptions
from torch_denkf.objectives.denkf import DEnKFLoss
from torch_denkf.objectives.gaussian import GaussianLoss
from torch_denkf.objectives.mixture import MixtureLoss
from torch_denkf.objectives.observation import ObservationLoss
from torch_denkf.objectives.sensor import SensorLoss
from torch_denkf.objectives.transition import TransitionLoss

__all__ = [
    "DEnKFLoss",
    "GaussianLoss",
    "MixtureLoss",
    "ObservationLoss",
    "SensorLoss",
    "TransitionLoss",
    "ReadingsOptions",
    "SequenceOptions",
]
