"""Attacks on every border of the library, and runs that last: is the result right, or does a message say what is not?"""
