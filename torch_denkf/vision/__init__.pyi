from .camera import KITTI_HEIGHT, CanonicalCamera
from .epipolar import TwoView, fit_two_view, track_corners, two_view_motion
from .expansion import Expansion, focus_of_expansion
from .flow import coarse_flow, dense_flow, median_turn
from .motion import image_motion
from .poses import KITTI_DT, poses_to_state, state_to_poses
from .road import road_correlation
from .shapes import FLOW_SHAPE, ROAD_PITCHES, ROAD_SHAPE, ROAD_SHIFTS, TWO_VIEW_SHAPE
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
    "TWO_VIEW_SHAPE",
    "TwoView",
    "coarse_flow",
    "dense_flow",
    "fit_two_view",
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
    "track_corners",
    "two_view_motion",
]
