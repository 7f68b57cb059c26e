"""What examples/dm_control_arms.py is made of."""
