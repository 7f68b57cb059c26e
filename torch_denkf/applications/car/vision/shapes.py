"""Shapes of flow and road correlation, in a module without OpenCV."""

from __future__ import annotations

import numpy as np

__all__ = [
    "CELL",
    "FOCUS_PRIOR",
    "FOCUS_STD",
    "FLOW_SHAPE",
    "ROAD_PITCHES",
    "ROAD_SHAPE",
    "ROAD_SHIFTS",
    "TWO_VIEW_SHAPE",
]

FLOW_SHAPE = (3, 25, 79)  # channels of coarse_flow, rows, columns; the same for every camera
CELL = 0.05  # m along the road
ROAD_PITCHES = np.arange(-8, 5) * 0.005  # rad, camera's axis above (+) the road: 0.02 up and 0.04 down
ROAD_SHIFTS = np.arange(-3, 66) * CELL  # m forwards between the two images: up to 113 km/h at 10 Hz
ROAD_SHAPE = (len(ROAD_PITCHES), len(ROAD_SHIFTS))
FOCUS_PRIOR, FOCUS_STD = (0.0, -0.01), (0.06, 0.05)  # prior: the camera looks in the direction of travel
TWO_VIEW_SHAPE = (8,)  # result of two_view_motion
