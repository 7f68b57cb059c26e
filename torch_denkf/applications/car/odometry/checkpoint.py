"""Loads a trained car filter from a folder."""

from __future__ import annotations

from pathlib import Path

from torch_denkf.applications.car.odometry.filter import CarFilter, car_filter
from torch_denkf.deployment.folder import load_folder

__all__ = ["load_car_filter"]


def load_car_filter(folder: str | Path) -> CarFilter:
    """Loads a filter from a folder of :func:`torch_denkf.pretrained.save_pretrained`. Nothing in the files is executed.

    Raises:
        FileNotFoundError: if the folder has no filter.
        ValueError: if a file is damaged, belongs to another filter, or to another robot.
    """
    return load_folder(folder, {CarFilter.builder: car_filter})  # type: ignore[return-value]
