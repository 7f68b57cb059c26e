"""Visual odometry on KITTI, by leave-one-drive-out cross-validation."""
