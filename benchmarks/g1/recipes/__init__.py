"""Filters by name. One of your own: a :class:`G1Recipe` with ``@register``, in a file in this folder."""

from benchmarks.g1.recipes._base import FILTERS, G1Recipe, register

FILTERS.import_all(__name__, __path__)

__all__ = ["FILTERS", "G1Recipe", "register"]
