"""Long runs: a module for each part, with functions that return the jobs for the rows of its table by name."""
