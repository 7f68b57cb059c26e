"""Filters on a GPU: what a step costs at each batch size, and what a simulator's step leaves for it."""
