"""A trained car filter as a folder: weights that are data only, and a text file that says what they belong to."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file

import torch_denkf
from torch_denkf.odometry.car import CarFilter, CarSettings

__all__ = ["load_car_filter", "read_config", "save_car_filter"]

FORMAT = "torch_denkf.car/1"
WEIGHTS, CONFIG = "weights.safetensors", "config.json"


def save_car_filter(car: CarFilter, folder: str | Path, *, training: Mapping[str, Any] | None = None) -> Path:
    """Writes a filter to a folder.

    ``weights.safetensors`` gets parameters and buffers; ``config.json`` gets the settings (with the inflation as it is
    now), the versions that wrote it, and what is known of the training.

    Args:
        car: the filter.
        folder: made where it is not there; a filter in it is replaced.
        training: command, seed, drives: plain values, for the record alone.

    Returns:
        The folder.

    Raises:
        OSError: if the folder cannot be written to.
        TypeError: if ``training`` holds what JSON does not know.

    Example:
        >>> import tempfile
        >>> from torch_denkf.odometry import car_filter
        >>> folder = save_car_filter(car_filter(ensemble_size=8), tempfile.mkdtemp(), training={"seed": 0})
        >>> load_car_filter(folder).settings.ensemble_size
        8
    """
    folder = Path(folder).expanduser()
    settings = {**asdict(car.settings), "inflation": car.inflation}
    versions = {"torch_denkf": torch_denkf.__version__, "torch": str(torch.__version__)}
    config = {"format": FORMAT, "settings": settings, "versions": versions, "training": dict(training or {})}
    text = json.dumps(config, indent=1)
    folder.mkdir(parents=True, exist_ok=True)
    weights = {name: value.detach().cpu().contiguous() for name, value in car.state_dict().items()}
    save_file(weights, folder / f"{WEIGHTS}.part")
    (folder / f"{CONFIG}.part").write_text(text + "\n")
    for name in (WEIGHTS, CONFIG):  # written whole or not at all
        os.replace(folder / f"{name}.part", folder / name)
    return folder


def read_config(folder: str | Path) -> dict[str, Any]:
    """What :func:`save_car_filter` wrote beside the weights.

    Raises:
        FileNotFoundError: if there is no filter in the folder.
        ValueError: if the file is damaged or of another format.
    """
    file = Path(folder).expanduser() / CONFIG
    if not file.is_file():
        raise FileNotFoundError(f"no car filter in {file.parent}: it has no {CONFIG}; `denkf train` leaves one")
    try:
        config = json.loads(file.read_text())
    except ValueError as error:
        raise ValueError(f"{file} is not JSON ({error}); restore it from a copy, or train anew") from error
    if not isinstance(config, dict) or config.get("format") != FORMAT or not isinstance(config.get("settings"), dict):
        raise ValueError(f"{file} does not describe a car filter (format {FORMAT!r}); pass a folder of `denkf train`")
    return config


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
    folder = Path(folder).expanduser()
    settings = read_config(folder)["settings"]
    known = {field.name for field in fields(CarSettings)}
    if unknown := sorted(set(settings) - known):
        raise ValueError(f"{folder / CONFIG} has settings {unknown}, which this version does not know; update it")
    try:
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in settings.items()}
        car = CarFilter(CarSettings(**values))
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{folder / CONFIG} does not make a filter: {error}") from error
    file = folder / WEIGHTS
    if not file.is_file():
        raise FileNotFoundError(f"no weights {file}; restore the file from a copy, or train anew")
    try:
        weights = load_file(file)
    except (SafetensorError, ValueError) as error:
        raise ValueError(f"{file} cannot be read ({error}); restore it from a copy, or train anew") from error
    try:
        car.load_state_dict(weights)
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"{file} does not fit {CONFIG} beside it: {reason}") from error
    return car.eval()
