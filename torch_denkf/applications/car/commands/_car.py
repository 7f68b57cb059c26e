"""Loads the car filter of a command."""

from __future__ import annotations

from pathlib import Path

from torch_denkf._checks import check_count
from torch_denkf.applications.car.odometry.filter import CarFilter
from torch_denkf.pretrained import from_pretrained

__all__ = ["load_car", "set_threads"]


def load_car(name_or_folder: str | Path) -> CarFilter:
    """Returns the filter of that name or in that folder.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is damaged, or of another robot.
    """
    car = from_pretrained(name_or_folder)
    if not isinstance(car, CarFilter):
        raise ValueError(f"{name_or_folder} is a {type(car).__name__}; pass car-odometry, or a folder of `denkf train`")
    return car


def set_threads(count: int) -> None:
    """Sets the number of threads of torch and OpenCV."""
    import cv2
    import torch

    check_count("--threads", count)
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
