"""Keeps what the library computes as numbers: a change that should change nothing is seen to change none."""
