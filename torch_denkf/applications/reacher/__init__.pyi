from .encoders import reacher_env
from .filter import reacher

__all__ = [
    "reacher",
    "reacher_env",
]
