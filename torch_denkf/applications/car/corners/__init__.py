"""Drives as stereo corners and turn rates: files, motion between rows, replay."""
