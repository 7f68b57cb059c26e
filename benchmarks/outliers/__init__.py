"""Readings of which a share is wrong: a cart."""
