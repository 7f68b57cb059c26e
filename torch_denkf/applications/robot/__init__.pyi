from .model import RobotModel, robot_model

__all__ = [
    "RobotModel",
    "robot_model",
]
