from .disturbances import BlackFrames, Blur, Brightness, OccludingBox, SaltAndPepper
from .hold import HoldReading
from .late_actions import LateActions
from .linear import LinearGaussianEnv
from .missing import MissingFrames
from .pendulum import NoisyPendulumEnv
from .replay import ReplayEnv

__all__ = [
    "BlackFrames",
    "Blur",
    "Brightness",
    "HoldReading",
    "LateActions",
    "LinearGaussianEnv",
    "MissingFrames",
    "NoisyPendulumEnv",
    "OccludingBox",
    "ReplayEnv",
    "SaltAndPepper",
]
