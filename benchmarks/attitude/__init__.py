"""Estimates the tilt of a body from a gyro and an accelerometer."""
