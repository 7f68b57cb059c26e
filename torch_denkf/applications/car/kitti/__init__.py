"""Drives in the layout of KITTI's odometry benchmark: read, rendered, mirrored, and as a data set."""
