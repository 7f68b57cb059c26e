"""Environments: toy systems, replays and a simulated arm. They know nothing about filters."""

from torch_denkf.envs.kitti import KITTIReplayEnv
from torch_denkf.envs.linear import LinearGaussianEnv
from torch_denkf.envs.ur5 import UR5TableEnv
from torch_denkf.envs.ur5_expert import UR5Expert

__all__ = ["KITTIReplayEnv", "LinearGaussianEnv", "UR5TableEnv", "UR5Expert"]
