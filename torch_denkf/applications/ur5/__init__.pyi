from .data.replay import UR5ExperienceReplay
from .envs.table import UR5TableEnv

__all__ = [
    "UR5ExperienceReplay",
    "UR5TableEnv",
]
