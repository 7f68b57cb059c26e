"""Parts of examples/kitti_odometry.py: what is read, built, trained, measured and drawn."""
