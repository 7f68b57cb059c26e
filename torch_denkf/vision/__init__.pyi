from .camera import KITTI_HEIGHT, CanonicalCamera
from .expansion import Expansion, focus_of_expansion
from .flow import coarse_flow, dense_flow, median_turn
from .motion import image_motion
from .poses import KITTI_DT, poses_to_state, state_to_poses
from .road import road_correlation
from .shapes import FLOW_SHAPE, ROAD_PITCHES, ROAD_SHAPE, ROAD_SHIFTS
from .signs import FLOW_SIGNS, PICTURE_SIGNS, flow_signs, picture_signs, plane_distance, static_region

__all__ = [
    "CanonicalCamera",
    "Expansion",
    "FLOW_SHAPE",
    "FLOW_SIGNS",
    "KITTI_DT",
    "KITTI_HEIGHT",
    "PICTURE_SIGNS",
    "ROAD_PITCHES",
    "ROAD_SHAPE",
    "ROAD_SHIFTS",
    "coarse_flow",
    "dense_flow",
    "flow_signs",
    "focus_of_expansion",
    "image_motion",
    "median_turn",
    "picture_signs",
    "plane_distance",
    "poses_to_state",
    "road_correlation",
    "state_to_poses",
    "static_region",
]
