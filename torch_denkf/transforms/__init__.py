"""What torchrl environments see of a filter, and what disturbs its frames."""

from torch_denkf.filters._primer import LastAction
from torch_denkf.transforms.denkf import DEnKFTransform
from torch_denkf.transforms.disturbances import BlackFrames, Blur, Brightness, OccludingBox, SaltAndPepper
from torch_denkf.transforms.hold import HoldReading
from torch_denkf.transforms.missing import MissingFrames

__all__ = [
    "BlackFrames",
    "Blur",
    "Brightness",
    "DEnKFTransform",
    "HoldReading",
    "LastAction",
    "MissingFrames",
    "OccludingBox",
    "SaltAndPepper",
]
