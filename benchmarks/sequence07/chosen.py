"""All parameters of the study, each estimated from drive 0022 alone, which has no poses.

``python -m benchmarks.sequence07.calibration`` estimates them again.
"""

#: Residual radial distortion after rectification, and disparity offsets in pixels, by the likelihood of corners.
CAMERA = {"radial": (0.004, 0.0256, -0.0099), "disparity_offset": (0.38, 0.382, 0.371, 0.659, -2.033, -3.549, 2.889)}

#: Noise of corners, by the same likelihood: fields of CornerNoise.
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


#: Noise of the filters, by the likelihood of their readings: process noise of the twist per row, in rad/s and m/s;
#: decay factors of the twist and of its last change; factor on the corners' covariance, and noise that is added to it,
#: in rad and m; the gyro's noise in rad/s.
FILTER = {
    "pitch": 0.0116,
    "yaw": 0.00525,
    "roll": 0.013,
    "side": 0.0325,
    "down": 0.0241,
    "ahead": 0.0312,
    "kept_pitch": 0.621,
    "kept_yaw": 0.996,
    "kept_roll": 0.542,
    "kept_side": 0.978,
    "swing_pitch": 0.524,
    "swing_yaw": 0.906,
    "swing_roll": 0.23,
    "swing_ahead": 0.916,
    "scale": 1.31,
    "floor_turn": 0.000108,
    "floor_move": 4.1e-05,
    "gyro": 0.0499,
}

#: Standard deviations of the slip, in rad/m and m/m, which is reset when the tracker finds new corners; and its decay
#: factor per row. HALVES: from the difference of the motions by two halves of the corners. LENS: from the difference of
#: the motions with the estimated lens and with KITTI's, as the lens of another day may have such an error.
HALVES = (0.00015, 0.00017, 0.00023, 0.0058, 0.0045, 0.011)
LENS = (0.00013, 0.00069, 0.00012, 0.0097, 0.0035, 0.028)
SLIP_KEPT = 0.957
