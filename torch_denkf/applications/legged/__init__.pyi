from .contacts import contacts
from .environment import QUADRUPED, LeggedErrors, quadruped_env, trot
from .filter import legged_filter
from .noises import LeggedNoises

__all__ = [
    "QUADRUPED",
    "LeggedErrors",
    "LeggedNoises",
    "contacts",
    "legged_filter",
    "quadruped_env",
    "trot",
]
