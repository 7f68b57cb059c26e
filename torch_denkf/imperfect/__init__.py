"""Imperfect sensors: occlusion, coloured errors, outliers, invalid readings."""

from torch_denkf.imperfect.bias import FadingBias
from torch_denkf.imperfect.contaminated import Contaminated
from torch_denkf.imperfect.rejection import RejectReadings
from torch_denkf.imperfect.visible import Visibility, Visible

__all__ = [
    "Contaminated",
    "FadingBias",
    "RejectReadings",
    "Visibility",
    "Visible",
]
