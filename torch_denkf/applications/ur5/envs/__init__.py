"""The UR5 table as an environment, its expert, and the collection of demonstrations."""
