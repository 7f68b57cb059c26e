"""Shares among the studies of arms behind a camera: readings, motions, recipes, training, scores and pages."""

JOINTS = 7  # of each arm: the first numbers of a state, in rad
