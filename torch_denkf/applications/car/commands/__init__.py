"""Terminal commands of the car application."""
