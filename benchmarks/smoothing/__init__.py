"""Evaluates smoothers on chaotic systems, compared with DAPPER, and with trained sensors."""
