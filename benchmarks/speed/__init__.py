"""Compares the speed of this library with its peers, a textbook step, and the machine's floor; ``make bench``."""
