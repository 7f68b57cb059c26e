"""Differentiable Bayesian filters for robots as TorchRL parts."""

__version__ = "0.1.0"
