"""Compares policies on a belief with policies with memory: a mountain hike, a pendulum and a cartpole."""
