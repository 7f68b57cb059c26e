"""Orientation of an inertial sensor on BROAD."""
