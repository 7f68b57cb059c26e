"""Filters by name. One of your own: a :class:`UR5Recipe` with ``@register``, in a file in this folder."""

from benchmarks.ur5.recipes._base import FILTERS, UR5Recipe, register

FILTERS.import_all(__name__, __path__)

__all__ = ["FILTERS", "UR5Recipe", "register"]
