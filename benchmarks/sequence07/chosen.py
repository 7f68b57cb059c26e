"""All numbers of the study that were chosen, each by drive 0022 alone, which has no poses.

``python -m benchmarks.sequence07.calibration`` finds them again.
"""

#: What the lens's rectification has left, and what disparities are short of in pixels: by the likelihood of corners.
CAMERA = {"radial": (0.004, 0.0256, -0.0099), "disparity_offset": (0.38, 0.382, 0.371, 0.659, -2.033, -3.549, 2.889)}

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

#: Error of the corners' motion that lasts, in rad/m and m/m, drawn again where the tracker finds new corners; and which
#: share is left a row later. HALVES: by how much the motions of two halves of the corners differ. LENS: what the lens
#: that was found changes of KITTI's, because that of another day is as far off.
HALVES = (0.00015, 0.00017, 0.00023, 0.0058, 0.0045, 0.011)
LENS = (0.00013, 0.00069, 0.00012, 0.0097, 0.0035, 0.028)
SLIP_KEPT = 0.957
