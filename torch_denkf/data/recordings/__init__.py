"""Recordings of users: images and tables of readings over time, resampled onto one clock."""
