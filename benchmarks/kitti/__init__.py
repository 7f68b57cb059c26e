"""Visual odometry on KITTI, leaving one drive out after the other."""
