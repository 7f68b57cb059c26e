from .filter import imu
from .log import imu_rows, orientations

__all__ = ["imu", "imu_rows", "orientations"]
