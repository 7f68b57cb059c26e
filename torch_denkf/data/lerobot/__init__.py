"""Recordings of real robots in LeRobot's layout."""
