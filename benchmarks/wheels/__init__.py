"""A simulated robot on wheels, for the study of members and tests of motions."""
