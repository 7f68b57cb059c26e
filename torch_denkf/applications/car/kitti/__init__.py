"""Drives in the layout of KITTI's odometry benchmark: reader, renderer, mirror images, data set."""
