"""What legged robots register with the library: nothing yet that is stored or run by a command."""

from __future__ import annotations

BUILDERS: dict[str, str] = {}
COMMANDS: dict[str, tuple[str, str]] = {}
