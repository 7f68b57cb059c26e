"""Runs that last: a module for each part, with a function ``rows`` that yields the rows of its table."""
