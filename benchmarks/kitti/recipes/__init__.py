"""Filters by name. One of your own: a :class:`KITTIRecipe` with ``@register``, in a file in this folder."""

from benchmarks.kitti.recipes._base import FILTERS, REACH, KITTIRecipe, register

FILTERS.import_all(__name__, __path__)

__all__ = ["FILTERS", "REACH", "KITTIRecipe", "register"]
