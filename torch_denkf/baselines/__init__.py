"""Baselines for comparison with the library's filters."""

from torch_denkf.baselines.bkf import BackpropKF
from torch_denkf.baselines.iterated import IEnKS
from torch_denkf.baselines.lstm import LSTMFilter

__all__ = [
    "BackpropKF",
    "IEnKS",
    "LSTMFilter",
]
