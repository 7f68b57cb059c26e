"""Estimates how fast a walking robot's base is, by its inertial sensor, joints and feet."""
