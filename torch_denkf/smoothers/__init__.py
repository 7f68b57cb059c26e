"""Smoothers: what later readings say about earlier states, on top of any filter."""

from torch_denkf.smoothers.fixed_lag import FixedLag

__all__ = ["FixedLag"]
