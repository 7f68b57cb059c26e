"""Holds the borders where inputs come in: a module for each, with a function ``targets`` of what may be wrong."""
