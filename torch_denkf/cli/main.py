"""``denkf``: the library's work from a terminal, one sub-command each."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

__all__ = ["main"]

COMMANDS = {
    "collect-ur5": ("collect_ur5", "collect demonstrations of the UR5 table"),
    "render-kitti": ("render_kitti", "render drives in KITTI's layout"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a sub-command.

    Args:
        arguments: words of the command line; by default the process's own.

    Returns:
        The exit status: 0; 2 with a message on stderr for a mistake.

    Example:
        >>> main([])
        usage: denkf COMMAND ...
        ...
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        lines = [f"  {name:<14}{text}" for name, (_, text) in COMMANDS.items()]
        sys.stdout.write("\n".join(["usage: denkf COMMAND ...", "", *lines, "", "denkf COMMAND --help says more.", ""]))
        return 0
    if words[0] not in COMMANDS:
        sys.stderr.write(f"error: unknown command {words[0]!r}; there are {', '.join(COMMANDS)}\n")
        return 2
    return import_module(f"torch_denkf.cli.{COMMANDS[words[0]][0]}").main(words[1:])
