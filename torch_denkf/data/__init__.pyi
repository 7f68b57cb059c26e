from .episodes import Episode
from .kitti.drive import list_kitti_drives, read_kitti_drive
from .kitti.frames import drive_frames, frames_at, sample_windows
from .kitti.gaps import bridge_gaps, steps_between
from .kitti.mirror import mirror_drive
from .kitti.motion import with_motion
from .kitti.render import random_drive, render_drives, roadside_scene, write_drives
from .kitti.replay import KITTIOdometryExperienceReplay
from .lerobot.lag import lag_errors
from .lerobot.repeats import repeated_pictures
from .lerobot.replay import LeRobotExperienceReplay as LeRobotExperienceReplay
from .lerobot.replay import LeRobotReplay
from .lerobot.rows import recording_from_rows
from .options import ReplayOptions
from .recordings.frames import Images, Video
from .recordings.replay import Recording, RecordingReplay
from .recordings.tables import Table
from .replay import EpisodeReplay
from .systems import lorenz96_step, lorenz96_tendency
from .trajectories import write_trajectory
from .ur5.replay import UR5ExperienceReplay

__all__ = [
    "Episode",
    "EpisodeReplay",
    "Images",
    "KITTIOdometryExperienceReplay",
    "LeRobotReplay",
    "Recording",
    "RecordingReplay",
    "ReplayOptions",
    "Table",
    "UR5ExperienceReplay",
    "Video",
    "bridge_gaps",
    "drive_frames",
    "frames_at",
    "lag_errors",
    "list_kitti_drives",
    "lorenz96_step",
    "lorenz96_tendency",
    "mirror_drive",
    "random_drive",
    "read_kitti_drive",
    "recording_from_rows",
    "render_drives",
    "repeated_pictures",
    "roadside_scene",
    "sample_windows",
    "steps_between",
    "with_motion",
    "write_drives",
    "write_trajectory",
]
