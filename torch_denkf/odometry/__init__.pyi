from .car import CarFilter, CarSettings, car_filter
from .checkpoint import load_car_filter, read_config, save_car_filter
from .training import Updates, assign_roles, train_car_filter

__all__ = [
    "CarFilter",
    "CarSettings",
    "Updates",
    "assign_roles",
    "car_filter",
    "load_car_filter",
    "read_config",
    "save_car_filter",
    "train_car_filter",
]
