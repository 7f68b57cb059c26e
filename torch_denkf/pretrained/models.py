"""What builds the filters that are stored as folders: functions of plain numbers."""

from __future__ import annotations

from collections.abc import Callable

from torch_denkf.filters import Filter
from torch_denkf.odometry.car import CarFilter, car_filter
from torch_denkf.pretrained.reacher import ReacherFilter, reacher
from torch_denkf.pretrained.ur5_table import UR5TableFilter, ur5_table

__all__ = ["BUILDERS", "car_filter", "reacher", "ur5_table"]

#: By the name that a folder's ``config.json`` says.
BUILDERS: dict[str, Callable[..., Filter]] = {
    CarFilter.builder: car_filter,
    ReacherFilter.builder: reacher,
    UR5TableFilter.builder: ur5_table,
}
