"""Faults that nobody announces: how soon a monitor tells, and what a gate makes of them."""
