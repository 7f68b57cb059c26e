"""Error and calibration metrics, on plain tensors."""

from torch_denkf.metrics.calibration import spread_skill_ratio
from torch_denkf.metrics.odometry import EndpointError, dead_reckoning, kitti_endpoint_error, wrap_angle

__all__ = ["EndpointError", "dead_reckoning", "kitti_endpoint_error", "spread_skill_ratio", "wrap_angle"]
