"""Diagnosis: observers of a filter that warn or raise, and checks of an analysis of one's own.

A filter calls its ``observers`` with itself and a :class:`~torch_denkf.filters.finish.Record` of each run.
"""

from __future__ import annotations

from typing import Any

from torch_denkf.diagnosis.behind import check_behind as check_behind
from torch_denkf.diagnosis.brightness import look_at_brightness as look_at_brightness
from torch_denkf.diagnosis.ceiling import CeilingReached
from torch_denkf.diagnosis.check import check_analysis
from torch_denkf.diagnosis.collapse import NarrowEnsemble
from torch_denkf.diagnosis.composition import check_composition as check_composition
from torch_denkf.diagnosis.errors import entry_of as entry_of
from torch_denkf.diagnosis.errors import explained as explained
from torch_denkf.diagnosis.errors import missing_entry as missing_entry
from torch_denkf.diagnosis.evaluation import Evaluation as Evaluation
from torch_denkf.diagnosis.evaluation import evaluate
from torch_denkf.diagnosis.inputs import check_actions as check_actions
from torch_denkf.diagnosis.inputs import check_inputs as check_inputs
from torch_denkf.diagnosis.inputs import check_joined_readings as check_joined_readings
from torch_denkf.diagnosis.inputs import check_named_readings as check_named_readings
from torch_denkf.diagnosis.inputs import check_noise as check_noise
from torch_denkf.diagnosis.inputs import check_precision as check_precision
from torch_denkf.diagnosis.inputs import readings_to_leave_out as readings_to_leave_out
from torch_denkf.diagnosis.masks import UnreadMasks
from torch_denkf.diagnosis.noises import WrongNoise
from torch_denkf.diagnosis.policy import PolicyStart
from torch_denkf.diagnosis.reasons import why_not_finite as why_not_finite
from torch_denkf.diagnosis.shapes import ReadingRanks
from torch_denkf.diagnosis.slices import UnmarkedSlices

__all__ = [
    "check_analysis",
    "evaluate",
]


def default_observers() -> list[Any]:
    """Returns the observers that a new filter has."""
    return [
        UnmarkedSlices(),
        ReadingRanks(),
        UnreadMasks(),
        WrongNoise(),
        CeilingReached(),
        NarrowEnsemble(),
        PolicyStart(),
    ]
