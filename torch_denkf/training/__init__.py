"""Training of filters, in stages."""

from torch_denkf.training.checkpoint import read_checkpoint, write_checkpoint
from torch_denkf.training.distributed import Processes
from torch_denkf.training.logs import RunLogs
from torch_denkf.training.stage import Stage
from torch_denkf.training.trainer import FilterTrainer

__all__ = ["FilterTrainer", "Processes", "RunLogs", "Stage", "read_checkpoint", "write_checkpoint"]
