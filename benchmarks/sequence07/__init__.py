"""Estimates the path of a whole KITTI drive from stereo corners and turn rates."""
