"""Tells how many members an ensemble needs."""
