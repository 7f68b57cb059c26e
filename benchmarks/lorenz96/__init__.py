"""Simulated systems: Lorenz-96 with known and with learned parts, and one with a biased, heteroscedastic sensor."""
