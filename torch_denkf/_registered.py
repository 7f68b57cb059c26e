"""Look-up by name of what outer rings register with inner ones, which import nothing of theirs.

A folder of ``torch_denkf.applications`` has a file ``registered.py`` with ``BUILDERS`` and ``COMMANDS``, and weights in
``weights/NAME/``. Nothing else of the library knows an application. The kit's rooms that a filter uses by default
are here, too: ``diagnosis`` and ``compilation``.
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
    """Functions that build filters from plain numbers, by the name that a folder's ``config.json`` says."""
    return {name: resolve_name(place) for each in _all() for name, place in each.BUILDERS.items()}


def commands() -> dict[str, tuple[str, str]]:
    """Maps the name of each command of the terminal to its place and its description."""
    return {name: command for each in _all() for name, command in each.COMMANDS.items()}


def compiler() -> ModuleType:
    """Returns the room of torch's compiler; importing inductor itself, which it does later, takes half a second."""
    return import_module("torch_denkf.compilation")


def deployment() -> ModuleType:
    """Returns the room of packaged steps."""
    return import_module("torch_denkf.deployment")


def diagnosis() -> ModuleType:
    """Returns the room of a filter's default observers."""
    return import_module("torch_denkf.diagnosis")


def primers() -> ModuleType:
    """Returns the room of torchrl's transforms, which stands on the filters."""
    return import_module("torch_denkf.transforms")


def weights() -> dict[str, Path]:
    """Returns folders of trained filters, by name."""
    return {file.parent.name: file.parent for file in sorted(APPLICATIONS.glob("*/weights/*/config.json"))}
