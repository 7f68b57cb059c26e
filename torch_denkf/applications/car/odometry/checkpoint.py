"""A trained car filter as a folder; see :mod:`torch_denkf.deployment.folder` for the files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from torch_denkf.applications.car.odometry.filter import CarFilter, car_filter
from torch_denkf.deployment.folder import load_folder, read_folder_config, save_folder

__all__ = ["load_car_filter", "read_config", "save_car_filter"]

_BUILDERS = {CarFilter.builder: car_filter}


def save_car_filter(car: CarFilter, folder: str | Path, *, training: Mapping[str, Any] | None = None) -> Path:
    """Writes a filter to a folder: ``weights.safetensors``, and ``config.json`` with the settings.

    Args:
        car: the filter; its inflation is kept as it is now.
        folder: made where it is not there; a filter in it is replaced.
        training: command, seed, drives: plain values, for the record alone.

    Returns:
        The folder.

    Raises:
        OSError: if the folder cannot be written to.
        TypeError: if ``training`` holds what JSON does not know.
        ValueError: if the filter was changed otherwise, so that its settings build another one.

    Example:
        >>> import tempfile
        >>> from torch_denkf.applications.car.odometry.filter import car_filter
        >>> folder = save_car_filter(car_filter(ensemble_size=8), tempfile.mkdtemp(), training={"seed": 0})
        >>> load_car_filter(folder).settings.ensemble_size
        8
    """
    settings = asdict(car.settings)
    return save_folder(car, folder, builder=car.builder, settings=settings, training=training, build=car_filter)


def read_config(folder: str | Path) -> dict[str, Any]:
    """What :func:`save_car_filter` wrote beside the weights.

    Raises:
        FileNotFoundError: if there is no filter in the folder.
        ValueError: if the file is damaged, of another format, or not of a car filter.
    """
    return read_folder_config(folder, _BUILDERS)


def load_car_filter(folder: str | Path) -> CarFilter:
    """Reads a filter that :func:`save_car_filter` wrote. Nothing in the files is executed.

    Args:
        folder: with ``config.json`` and ``weights.safetensors``.

    Returns:
        The filter, on the CPU, in evaluation mode.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file is damaged, of another format, or does not fit the other; the message names it.
    """
    return load_folder(folder, _BUILDERS)  # type: ignore[return-value]
