"""All numbers of the study that were chosen, each by drive 0022 alone, which has no poses.

``python -m benchmarks.sequence07.calibration`` finds them again.
"""

#: What the lens's rectification has left, and what disparities are short of in pixels: by the likelihood of corners.
CAMERA = {
    "radial": (0.004, 0.0256, -0.0099),
    "disparity_offset": (0.38, 0.382, 0.371, 0.659, -2.033, -3.549, 2.889),
}

#: Of corners, by the same likelihood: fields of CornerNoise.
CORNERS = {
    "pixel": 0.0476,
    "pixel_per_flow": 0.0041,
    "disparity": 0.0498,
    "disparity_per_flow": 0.0035,
    "stereo": 0.2627,
    "stereo_per_offset": 0.2553,
    "stereo_per_disparity": 0.0385,
    "stereo_stale": 2.03,
    "stereo_walk": 0.0719,
    "freedom": 1.78,
}


#: Of the filters, by the likelihood of their readings: what a row adds to the twist, in rad/s and m/s; which share of
#: it is kept, and of its last change; what is added to the corners' covariance, times a factor, in rad and m; the
#: gyro's noise in rad/s.
FILTER = {
    "pitch": 0.0116,
    "yaw": 0.006,
    "roll": 0.013,
    "side": 0.0326,
    "down": 0.0231,
    "ahead": 0.122,
    "kept_pitch": 0.619,
    "kept_yaw": 0.996,
    "kept_roll": 0.551,
    "kept_side": 0.972,
    "swing_pitch": 0.543,
    "swing_yaw": 0.869,
    "swing_roll": 0.207,
    "swing_ahead": 0.2,
    "scale": 1.43,
    "floor_turn": 0.000189,
    "floor_move": 0.000174,
    "gyro": 0.0491,
}

#: Error of the corners' motion that lasts, by how much the motions of two halves of the corners differ: standard
#: deviations in rad/s and m/s, and which share is left a row later.
SLIP = (0.0009, 0.001, 0.0015, 0.036, 0.028, 0.077)
SLIP_KEPT = 0.825
