"""A UR5 that one camera watches: joints, gripper and end effector."""
