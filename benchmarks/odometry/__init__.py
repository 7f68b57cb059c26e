"""Measures the errors of ``denkf odometry`` for a calibrated camera whose height is known or guessed."""
