"""Policies that read a belief, against policies that remember: the mountain hike and a pendulum without velocity."""
