"""Adds the inertial sensor to the library's registers."""

BUILDERS = {"imu": "torch_denkf.applications.imu.filter:imu"}
COMMANDS = {"orient": ("torch_denkf.applications.imu.commands:Orient", "orientation from an inertial sensor's log")}
