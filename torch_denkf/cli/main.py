"""``denkf``: the library's work from a terminal, one sub-command each."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

import torch_denkf

__all__ = ["main"]

#: By name: the module whose ``main`` runs it, and what it does.
COMMANDS = {
    "info": ("info", "versions, devices, OpenGL, cache, optional extras"),
    "demo": ("demo", "watch a trained filter follow a car whose camera fails"),
    "render-kitti": ("render_kitti", "render drives in KITTI's layout"),
    "train": ("train", "train a car's filter on rendered or recorded drives"),
    "evaluate": ("evaluate", "errors of a trained filter on drives with known poses"),
    "odometry": ("odometry", "the path of a car from its camera's images or video"),
    "plot": ("plot", "draw a path and its uncertainty"),
    "cache": ("cache", "list, check or clear what is kept of earlier runs"),
    "collect-ur5": ("collect_ur5", "collect demonstrations of the UR5 table"),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a sub-command.

    Args:
        arguments: words of the command line; by default the process's own.

    Returns:
        The exit status: 0; 1 if what was checked is not in order; 2 with a message on stderr for a mistake; 130 when
        interrupted.

    Example:
        >>> main([])
        usage: denkf COMMAND ...
        ...
    """
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        lines = [f"  {name:<14}{text}" for name, (_, text) in COMMANDS.items()]
        end = "denkf COMMAND --help says more. For example: denkf demo --out runs/demo"
        sys.stdout.write("\n".join(["usage: denkf COMMAND ...", "", *lines, "", end, ""]))
        return 0
    if words[0] == "--version":
        sys.stdout.write(f"denkf {torch_denkf.__version__}\n")
        return 0
    if words[0] not in COMMANDS:
        sys.stderr.write(f"error: unknown command {words[0]!r}; there are {', '.join(COMMANDS)}\n")
        return 2
    try:
        command = import_module(f"torch_denkf.cli.{COMMANDS[words[0]][0]}")
    except KeyboardInterrupt:
        return 130
    return command.main(words[1:])


if __name__ == "__main__":
    raise SystemExit(main())
