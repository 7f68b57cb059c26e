"""Measures the error of ensembles of different sizes."""
