from .model import robot_model

__all__ = [
    "robot_model",
]
