"""Gating of outliers, monitors of innovations and signs of sensor faults."""

from torch_denkf.monitoring.black import BlackIsMissing
from torch_denkf.monitoring.chi_square import detectable_bias as detectable_bias
from torch_denkf.monitoring.filters import Gated, Monitored
from torch_denkf.monitoring.gate import GatedAnalysis as GatedAnalysis
from torch_denkf.monitoring.monitor import InnovationMonitor, MonitoredSensor
from torch_denkf.monitoring.signs import SignGate

__all__ = [
    "BlackIsMissing",
    "Gated",
    "InnovationMonitor",
    "Monitored",
    "MonitoredSensor",
    "SignGate",
]
