"""Simulated worlds, which know neither data sets nor filters: streets, a robot's table, a chaotic system."""
