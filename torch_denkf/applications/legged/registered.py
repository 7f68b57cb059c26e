"""Entries of legged robots in the library's registers."""

from __future__ import annotations

BUILDERS = {"quadruped": "torch_denkf.applications.legged.quadruped:quadruped"}
COMMANDS: dict[str, tuple[str, str]] = {}
