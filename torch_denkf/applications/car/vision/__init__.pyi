from .signs import PICTURE_SIGNS, flow_signs, picture_signs, plane_distance, static_region

__all__ = [
    "PICTURE_SIGNS",
    "flow_signs",
    "picture_signs",
    "plane_distance",
    "static_region",
]
