"""Estimates joints, gripper and end effector of a UR5 from one camera."""
