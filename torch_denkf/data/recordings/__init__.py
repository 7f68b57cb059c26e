"""One's own recordings: pictures and tables of numbers over time, brought onto one clock."""
