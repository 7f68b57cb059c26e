"""A whole drive of KITTI by stereo corners and turn rates."""
