"""Training of filters in stages, and calibration of a setting."""

from torch_denkf.training.calibration import choose, hold_last
from torch_denkf.training.distributed import Processes
from torch_denkf.training.kin import take_weights
from torch_denkf.training.logs import RunLogs
from torch_denkf.training.stage import Stage
from torch_denkf.training.trainer import FilterTrainer

__all__ = [
    "FilterTrainer",
    "Processes",
    "RunLogs",
    "Stage",
    "choose",
    "hold_last",
    "take_weights",
]
