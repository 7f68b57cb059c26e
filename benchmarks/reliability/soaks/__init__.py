"""Long runs: a module for each part, with a function ``jobs``: what makes each row of its table, by name."""
