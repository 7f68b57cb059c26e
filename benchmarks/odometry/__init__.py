"""Measures what a camera of one's own gets from ``denkf odometry``: no poses, a height that is known or guessed."""
