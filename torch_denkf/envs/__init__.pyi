from .linear import LinearGaussianEnv
from .pendulum import NoisyPendulumEnv
from .replay import ReplayEnv

__all__ = [
    "LinearGaussianEnv",
    "NoisyPendulumEnv",
    "ReplayEnv",
]
