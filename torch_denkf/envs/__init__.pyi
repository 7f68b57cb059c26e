from .kitti import KITTIReplayEnv
from .linear import LinearGaussianEnv
from .pendulum import NoisyPendulumEnv
from .replay import RecordedPolicy, ReplayEnv
from .ur5.collect import collect_ur5_demos
from .ur5.expert import UR5Expert
from .ur5.table import UR5TableEnv

__all__ = [
    "KITTIReplayEnv",
    "LinearGaussianEnv",
    "NoisyPendulumEnv",
    "RecordedPolicy",
    "ReplayEnv",
    "UR5Expert",
    "UR5TableEnv",
    "collect_ur5_demos",
]
