from .encoders import NoisyEncoders, reacher_env
from .filter import reacher

__all__ = [
    "NoisyEncoders",
    "reacher",
    "reacher_env",
]
