"""Study of a real arm seen by the robot's head camera."""
