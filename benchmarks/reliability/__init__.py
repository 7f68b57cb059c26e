"""Attacks on every border of the library, and runs that last: right, or a message that says what is not."""
