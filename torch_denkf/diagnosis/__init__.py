"""Diagnosis: checks of an analysis of one's own, warnings, signs of a collapsed ensemble."""

from torch_denkf.diagnosis.check import check_analysis

__all__ = [
    "check_analysis",
]
