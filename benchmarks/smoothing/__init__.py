"""Smoothers on chaotic systems, compared with DAPPER."""
