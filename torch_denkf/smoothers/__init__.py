"""Smoothers: correct earlier states by later readings, on top of any filter."""

from torch_denkf.smoothers.ensemble import EnKS, EnRTS
from torch_denkf.smoothers.fixed_lag import FixedLag
from torch_denkf.smoothers.particles import ParticleSmoother
from torch_denkf.smoothers.rts import RTSSmoother

__all__ = ["FixedLag", "EnKS", "EnRTS", "RTSSmoother", "ParticleSmoother"]
