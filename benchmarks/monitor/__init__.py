"""Unannounced faults: detection delay of a monitor, and errors with a gate."""
