"""Compares filters of a cart on readings with outliers."""
