"""Environments: toy systems and replays. They know nothing about filters."""

from torch_denkf.envs.kitti import KITTIReplayEnv
from torch_denkf.envs.linear import LinearGaussianEnv

__all__ = ["KITTIReplayEnv", "LinearGaussianEnv"]
