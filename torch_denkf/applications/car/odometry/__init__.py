"""Visual odometry of a car: filter, training, tracking of a drive, camera failures, scores."""
