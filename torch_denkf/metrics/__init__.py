"""Error and calibration metrics, on plain tensors."""

from torch_denkf.metrics.calibration import spread_skill_ratio

__all__ = ["spread_skill_ratio"]
