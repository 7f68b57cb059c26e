"""Image geometry of a camera over a road: arrays in, arrays out, by OpenCV."""

from torch_denkf.vision.camera import KITTI_HEIGHT, CanonicalCamera
from torch_denkf.vision.expansion import Expansion, focus_of_expansion
from torch_denkf.vision.flow import FLOW_SHAPE, coarse_flow, dense_flow, median_turn
from torch_denkf.vision.motion import image_motion
from torch_denkf.vision.road import ROAD_PITCHES, ROAD_SHAPE, ROAD_SHIFTS, road_correlation

__all__ = [
    "CanonicalCamera",
    "Expansion",
    "FLOW_SHAPE",
    "KITTI_HEIGHT",
    "ROAD_PITCHES",
    "ROAD_SHAPE",
    "ROAD_SHIFTS",
    "coarse_flow",
    "dense_flow",
    "focus_of_expansion",
    "image_motion",
    "median_turn",
    "road_correlation",
]
