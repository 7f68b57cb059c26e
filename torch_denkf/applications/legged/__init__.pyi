from .contacts import contacts
from .environment import QUADRUPED, LeggedEnv, LeggedErrors, quadruped_env, trot
from .filter import legged_filter
from .icub import ICUB, icub_log, icub_model
from .kinematics import LegKinematics
from .motion import LeggedMotion, legged_space
from .noises import LeggedNoises
from .velocity import base_velocity, base_velocity_of_moments

__all__ = [
    "ICUB",
    "QUADRUPED",
    "LegKinematics",
    "LeggedEnv",
    "LeggedErrors",
    "LeggedMotion",
    "LeggedNoises",
    "base_velocity",
    "base_velocity_of_moments",
    "contacts",
    "icub_log",
    "icub_model",
    "legged_filter",
    "legged_space",
    "quadruped_env",
    "trot",
]
