"""Errors of planar paths, as the KITTI benchmark and its users measure them."""
