"""Readers and generators of data."""

from torch_denkf.data._lerobot_rows import recording_from_rows
from torch_denkf.data.drives import random_drive, render_drives, roadside_scene, write_drives
from torch_denkf.data.frames import drive_frames, frames_at, sample_windows
from torch_denkf.data.gaps import bridge_gaps, steps_between
from torch_denkf.data.kitti import list_kitti_drives, read_kitti_drive
from torch_denkf.data.kitti_replay import KITTIOdometryExperienceReplay
from torch_denkf.data.lerobot import LeRobotExperienceReplay
from torch_denkf.data.lorenz96 import lorenz96_step, lorenz96_tendency
from torch_denkf.data.mirror import mirror_drive
from torch_denkf.data.motion import with_motion
from torch_denkf.data.trajectories import write_trajectory
from torch_denkf.data.ur5_replay import UR5ExperienceReplay

__all__ = [
    "KITTIOdometryExperienceReplay",
    "LeRobotExperienceReplay",
    "UR5ExperienceReplay",
    "bridge_gaps",
    "drive_frames",
    "frames_at",
    "list_kitti_drives",
    "lorenz96_step",
    "lorenz96_tendency",
    "mirror_drive",
    "random_drive",
    "read_kitti_drive",
    "recording_from_rows",
    "render_drives",
    "roadside_scene",
    "sample_windows",
    "steps_between",
    "with_motion",
    "write_drives",
    "write_trajectory",
]
