from .filter import ImuFilter, ImuSettings, imu
from .log import Orientations, imu_rows, orientations

__all__ = ["ImuFilter", "ImuSettings", "Orientations", "imu", "imu_rows", "orientations"]
