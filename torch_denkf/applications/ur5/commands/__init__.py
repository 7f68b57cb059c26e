"""The UR5 table's commands of the terminal."""
