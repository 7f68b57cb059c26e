"""``denkf``: the library's work from a terminal, one sub-command each."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pkgutil import resolve_name

import torch_denkf
from torch_denkf import _registered

__all__ = ["commands", "main"]

_OWN = {
    "info": ("torch_denkf.cli.info:Info", "versions, devices, OpenGL, cache, optional extras"),
    "log": ("torch_denkf.cli.log:Log", "what is in a log: streams, rates, gaps, units, delays"),
    "cache": ("torch_denkf.cli.cache:Cache", "list, check or clear what is kept of earlier runs"),
}


def commands() -> dict[str, tuple[str, str]]:
    """Maps names of commands to their place and their purpose; applications register theirs.

    Example:
        >>> sorted(commands())[:2]
        ['cache', 'collect-ur5']
    """
    return {**_OWN, **_registered.commands()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a sub-command.

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
    known = commands()
    words = list(sys.argv[1:] if arguments is None else arguments)
    if not words or words[0] in ("-h", "--help"):
        lines = [f"  {name:<14}{text}" for name, (_, text) in known.items()]
        end = "denkf COMMAND --help says more. For example: denkf demo --out runs/demo"
        sys.stdout.write("\n".join(["usage: denkf COMMAND ...", "", *lines, "", end, ""]))
        return 0
    if words[0] == "--version":
        sys.stdout.write(f"denkf {torch_denkf.__version__}\n")
        return 0
    if words[0] not in known:
        from torch_denkf.cli.command import meant  # here: `denkf --help` does not need it

        sys.stderr.write(f"error: unknown command {words[0]!r}{meant(words[0], list(known))}\n")
        return 2
    try:
        command = resolve_name(known[words[0]][0])
    except KeyboardInterrupt:
        return 130
    return command.main(words[1:])
