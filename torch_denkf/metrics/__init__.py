"""Error and calibration metrics, on plain tensors."""

from torch_denkf.metrics.calibration import ensemble_interval_coverage, interval_coverage, pit, spread_skill_ratio
from torch_denkf.metrics.consistency import nees
from torch_denkf.metrics.state import rotation_error, state_errors

__all__ = [
    "ensemble_interval_coverage",
    "interval_coverage",
    "nees",
    "pit",
    "rotation_error",
    "spread_skill_ratio",
    "state_errors",
]
