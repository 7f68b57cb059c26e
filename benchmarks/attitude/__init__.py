"""Estimates which way is up, by a gyro and an accelerometer."""
