"""Demonstrations of the UR5 table: their files, what is kept of them, and the data set."""
