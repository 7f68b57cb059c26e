"""A car's motion from its camera: the filter, its training, tracking a drive, failures of the camera, scores."""
