from .contacts import contacts
from .environment import QUADRUPED, LeggedErrors, quadruped_env, trot
from .filter import legged_filter
from .learned import LearnedContacts, last_rows, with_last_rows
from .noises import LeggedNoises

__all__ = [
    "QUADRUPED",
    "LearnedContacts",
    "LeggedErrors",
    "LeggedNoises",
    "contacts",
    "last_rows",
    "legged_filter",
    "quadruped_env",
    "trot",
    "with_last_rows",
]
