"""One folder a robot, with all that only this robot needs."""
