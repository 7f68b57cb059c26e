"""Smoothers on chaotic systems, beside DAPPER."""
