from .contacts import contacts
from .environment import LeggedErrors
from .filter import legged_filter
from .learned import LearnedContacts, last_rows, with_last_rows
from .noises import LeggedNoises
from .quadruped import QUADRUPED, quadruped_env, trot

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
