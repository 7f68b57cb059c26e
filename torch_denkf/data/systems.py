"""The chaotic system of :mod:`torch_denkf.simulation.lorenz96`, for whom looks for it among the data."""

from torch_denkf.simulation.lorenz96 import lorenz96_step, lorenz96_tendency

__all__ = ["lorenz96_step", "lorenz96_tendency"]
