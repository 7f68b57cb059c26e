"""Error and calibration metrics, on plain tensors."""

from torch_denkf.metrics.benchmark import WindowErrors, kitti_endpoint_errors, kitti_pathlength_error
from torch_denkf.metrics.calibration import (
    SpreadError,
    ensemble_interval,
    ensemble_interval_coverage,
    histogram_band,
    interval_coverage,
    pit,
    rank_histogram,
    spread_error,
    spread_skill_ratio,
)
from torch_denkf.metrics.consistency import NEES, gaussian_nll, nees
from torch_denkf.metrics.devkit import DevkitError, kitti_devkit_error
from torch_denkf.metrics.odometry import EndpointError, dead_reckoning, kitti_endpoint_error, wrap_angle
from torch_denkf.metrics.pareto import pareto_frontier
from torch_denkf.metrics.state import StateErrors, state_difference, state_errors

__all__ = [
    "DevkitError",
    "EndpointError",
    "NEES",
    "SpreadError",
    "StateErrors",
    "WindowErrors",
    "dead_reckoning",
    "ensemble_interval",
    "ensemble_interval_coverage",
    "gaussian_nll",
    "histogram_band",
    "interval_coverage",
    "kitti_devkit_error",
    "kitti_endpoint_error",
    "kitti_endpoint_errors",
    "kitti_pathlength_error",
    "nees",
    "pareto_frontier",
    "pit",
    "rank_histogram",
    "spread_error",
    "spread_skill_ratio",
    "state_difference",
    "state_errors",
    "wrap_angle",
]
