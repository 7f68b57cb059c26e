"""Adds the robots of robot_localization to the library's registers."""

BUILDERS: dict[str, str] = {}
COMMANDS = {
    "fuse": ("torch_denkf.applications.robot.commands:Fuse", "filter and smooth a log, and learn its noises"),
}
