"""Policies that read a belief, against policies that remember: a mountain hike, a pendulum and a cartpole."""
