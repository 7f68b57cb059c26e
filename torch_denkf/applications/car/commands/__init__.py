"""The car's commands of the terminal."""
