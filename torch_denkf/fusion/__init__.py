"""Several sensors in one filter: each with its own rate, noise, mask and delay."""

from torch_denkf.fusion.ahead import BeliefAhead
from torch_denkf.fusion.filter import FusedFilter
from torch_denkf.fusion.messages import message_rows
from torch_denkf.fusion.refiltering import Refiltering
from torch_denkf.fusion.sensor import FusedSensor
from torch_denkf.fusion.sensor_weights import SensorAttention

__all__ = [
    "BeliefAhead",
    "FusedFilter",
    "FusedSensor",
    "Refiltering",
    "SensorAttention",
    "message_rows",
]
