"""Studies and measurements, each with its results; run them from the repository's root."""
