"""Compares the speed of this library with its peers and a textbook step; ``make bench``."""
