"""Filters by name. To add a filter, decorate a :class:`KITTIRecipe` with ``@register`` in a file in this folder."""

from benchmarks.kitti.recipes._base import FILTERS, REACH, KITTIRecipe, register

FILTERS.import_all(__name__, __path__)

__all__ = ["FILTERS", "REACH", "KITTIRecipe", "register"]
