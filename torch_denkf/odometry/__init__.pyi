from .car import CarFilter, CarSettings, car_filter
from .checkpoint import load_car_filter, read_config, save_car_filter
from .evaluation import evaluate_car_filter, markdown_table, write_rows
from .failing_drive import drive_scores, track_failing_drive, usual_failures
from .failures import CameraFailure, fail_frames
from .images import read_camera, read_frames, read_times
from .paths import read_path, write_path
from .roles import assign_roles
from .tracking import TrackedBelief, track
from .training import Updates, train_car_filter

__all__ = [
    "CameraFailure",
    "CarFilter",
    "CarSettings",
    "TrackedBelief",
    "Updates",
    "assign_roles",
    "car_filter",
    "drive_scores",
    "evaluate_car_filter",
    "fail_frames",
    "load_car_filter",
    "markdown_table",
    "read_camera",
    "read_config",
    "read_frames",
    "read_path",
    "read_times",
    "save_car_filter",
    "track",
    "track_failing_drive",
    "train_car_filter",
    "usual_failures",
    "write_path",
    "write_rows",
]
