"""Baselines: what a filter of this library is compared with."""

from torch_denkf.baselines.bkf import BackpropKF
from torch_denkf.baselines.iterated import IEnKS
from torch_denkf.baselines.lstm import LSTMFilter

__all__ = [
    "BackpropKF",
    "IEnKS",
    "LSTMFilter",
]
