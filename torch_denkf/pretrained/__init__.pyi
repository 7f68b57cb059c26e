from .encoders import NoisyEncoders, reacher_env
from .folders import available, from_pretrained, save_pretrained
from .reacher import ReacherFilter, ReacherSettings, reacher
from .ur5_table import UR5TableFilter, UR5TableSettings, ur5_table

__all__ = [
    "NoisyEncoders",
    "ReacherFilter",
    "ReacherSettings",
    "UR5TableFilter",
    "UR5TableSettings",
    "available",
    "from_pretrained",
    "reacher",
    "reacher_env",
    "save_pretrained",
    "ur5_table",
]
