"""Filters: compositions of sub-models on one base."""

from torch_denkf.filters.base import Filter
from torch_denkf.filters.denkf import DEnKF
from torch_denkf.filters.kalman import KalmanFilter

__all__ = ["Filter", "DEnKF", "KalmanFilter"]
