"""A trained car filter from a folder that no other robot's filter may lie in."""

from __future__ import annotations

from pathlib import Path

from torch_denkf.applications.car.odometry.filter import CarFilter, car_filter
from torch_denkf.deployment.folder import load_folder

__all__ = ["load_car_filter"]


def load_car_filter(folder: str | Path) -> CarFilter:
    """Reads a filter that :func:`torch_denkf.pretrained.save_pretrained` wrote. Nothing in the files is executed.

    Raises:
        FileNotFoundError: if there is none in the folder.
        ValueError: if a file is damaged, is another one's, or of another robot.
    """
    return load_folder(folder, {CarFilter.builder: car_filter})  # type: ignore[return-value]
