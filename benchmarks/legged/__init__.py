"""Estimates the velocity of a walking robot's base from its inertial sensor, joints and feet."""
