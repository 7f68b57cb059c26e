"""How fast is a walking robot's base, by its inertial sensor, joints and feet?"""
