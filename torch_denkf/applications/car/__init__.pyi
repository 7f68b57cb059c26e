from .kitti.drive import read_kitti_drive
from .kitti.env import KITTIReplayEnv
from .kitti.frames import drive_frames
from .kitti.motion import with_motion
from .kitti.render import write_drives
from .kitti.replay import KITTIOdometryExperienceReplay
from .metrics.devkit import kitti_devkit_error
from .metrics.odometry import dead_reckoning, kitti_endpoint_error
from .modules.flow_sensor import FlowSensor
from .modules.unicycle import UnicycleMotion, UnicycleTransition
from .modules.unicycle_noise import UnicycleNoise
from .odometry.images import read_camera, read_frames
from .odometry.tracking import track
from .optical_flow import OpticalFlow

__all__ = [
    "FlowSensor",
    "KITTIOdometryExperienceReplay",
    "KITTIReplayEnv",
    "OpticalFlow",
    "UnicycleMotion",
    "UnicycleNoise",
    "UnicycleTransition",
    "dead_reckoning",
    "drive_frames",
    "kitti_devkit_error",
    "kitti_endpoint_error",
    "read_camera",
    "read_frames",
    "read_kitti_drive",
    "track",
    "with_motion",
    "write_drives",
]
