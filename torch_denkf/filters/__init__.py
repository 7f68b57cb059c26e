"""Filters: compositions of sub-models on one base."""

from torch_denkf.filters.base import Filter
from torch_denkf.filters.denkf import DEnKF
from torch_denkf.filters.ekf import EKF
from torch_denkf.filters.kalman import KalmanFilter
from torch_denkf.filters.particle import DPF, MixtureParticleFilter, ParticleFilter
from torch_denkf.filters.ukf import UKF

__all__ = ["Filter", "DEnKF", "KalmanFilter", "EKF", "UKF", "ParticleFilter", "DPF", "MixtureParticleFilter"]
