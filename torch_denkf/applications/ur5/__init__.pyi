from .data.replay import UR5ExperienceReplay
from .envs.collect import collect_ur5_demos
from .envs.table import UR5TableEnv

__all__ = [
    "UR5ExperienceReplay",
    "UR5TableEnv",
    "collect_ur5_demos",
]
