"""A filter between an arm and its policy: dm_control's reacher and manipulator."""
