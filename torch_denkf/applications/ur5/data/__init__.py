"""Demonstrations of the UR5 table, and the data set of them."""

from torch_denkf.applications.ur5.data.replay import UR5ExperienceReplay

__all__ = [
    "UR5ExperienceReplay",
]
