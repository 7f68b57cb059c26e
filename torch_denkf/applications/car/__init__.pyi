from .kitti.drive import read_kitti_drive
from .kitti.env import KITTIReplayEnv
from .kitti.motion import with_motion
from .kitti.render import write_drives
from .kitti.replay import KITTIOdometryExperienceReplay
from .metrics.odometry import dead_reckoning
from .modules.flow_sensor import FlowSensor
from .modules.unicycle import UnicycleMotion, UnicycleTransition
from .odometry.tracking import track
from .optical_flow import OpticalFlow

__all__ = [
    "FlowSensor",
    "KITTIOdometryExperienceReplay",
    "KITTIReplayEnv",
    "OpticalFlow",
    "UnicycleMotion",
    "UnicycleTransition",
    "dead_reckoning",
    "read_kitti_drive",
    "track",
    "with_motion",
    "write_drives",
]
