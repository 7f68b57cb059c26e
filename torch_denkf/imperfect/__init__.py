"""Imperfect sensors: occlusion, coloured errors."""

from torch_denkf.imperfect.bias import FadingBias
from torch_denkf.imperfect.visible import Visibility, Visible

__all__ = [
    "FadingBias",
    "Visibility",
    "Visible",
]
