"""Sub-models of a car's filter: motion, noise, pose, and sensors of optical flow."""
