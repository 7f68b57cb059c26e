"""A simulated robot on wheels, which the study of members and tests of motions share."""
