"""Filters by name. One of your own: a :class:`Recipe` with ``@register``, in a file in this folder."""

from importlib import import_module
from pkgutil import iter_modules

from benchmarks.ur5.recipes._base import FILTERS, Recipe, register

for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")

__all__ = ["FILTERS", "Recipe", "register"]
