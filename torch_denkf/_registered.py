"""Look-up of outer modules that inner ones use by name, without importing them directly.

A folder of ``torch_denkf.applications`` has a file ``registered.py`` with ``BUILDERS`` and ``COMMANDS``, and weights in
``weights/NAME/``. No other module depends on an application. ``diagnosis`` and ``compilation``, which a filter uses by
default, are looked up here, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable
from pkgutil import iter_modules, resolve_name

APPLICATIONS = Path(__file__).parent / "applications"


def _all() -> Iterator[ModuleType]:
    for application in iter_modules([str(APPLICATIONS)]):
        yield import_module(f"torch_denkf.applications.{application.name}.registered")


def builders() -> dict[str, Callable[..., Any]]:
    """Returns functions that build filters from plain numbers, by their name in ``config.json``."""
    return {name: resolve_name(place) for each in _all() for name, place in each.BUILDERS.items()}


def commands() -> dict[str, tuple[str, str]]:
    """Maps the name of each command of the terminal to its place and its description."""
    return {name: command for each in _all() for name, command in each.COMMANDS.items()}


def compiler() -> ModuleType:
    """Returns the module that calls torch's compiler; it imports inductor, which takes half a second, on first use."""
    return import_module("torch_denkf.compilation")


def deployment() -> ModuleType:
    """Returns the module of packaged steps."""
    return import_module("torch_denkf.deployment")


def diagnosis() -> ModuleType:
    """Returns the module of a filter's default observers."""
    return import_module("torch_denkf.diagnosis")


def primers() -> ModuleType:
    """Returns the module of torchrl's transforms, which depends on the filters."""
    return import_module("torch_denkf.transforms")


def weights() -> dict[str, Path]:
    """Returns folders of trained filters, by name."""
    return {file.parent.name: file.parent for file in sorted(APPLICATIONS.glob("*/weights/*/config.json"))}
