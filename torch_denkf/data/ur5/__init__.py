"""Demonstrations of the UR5 table, and the data set of them."""

from torch_denkf.data.ur5.replay import UR5ExperienceReplay

__all__ = ["UR5ExperienceReplay"]
