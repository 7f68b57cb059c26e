"""Progress of long work: a bar in a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
from typing import Any, TextIO

from tqdm import tqdm

__all__ = ["progress_bar"]

SECONDS = 10.0  # between two lines where there is no terminal; shorter work says nothing


def progress_bar(
    name: str, total: int | None, done: int = 0, *, unit: str = "it", shown: bool = True, every: float = SECONDS
) -> Any:
    """Returns tqdm's bar over ``total`` pieces of work, of which ``done`` are made: a context manager.

    In a terminal it is drawn. Elsewhere, in a log file for example, a line is written to stderr every ten seconds,
    or as often as asked for.

    Args:
        name: what is done.
        total: pieces; ``None`` where their number is not known.
        done: pieces that were made before.
        unit: what a piece is.
        shown: whether anything is shown at all.
        every: seconds between two lines where there is no terminal.

    Example:
        >>> with progress_bar("fit", 10, shown=False) as bar:
        ...     bar.set_postfix({"loss": 0.5}, refresh=False)
        ...     bar.update()
    """
    options: dict[str, Any] = {"total": total, "initial": done, "desc": name, "unit": unit, "disable": not shown}
    if not sys.stderr.isatty():
        options |= {"file": _Lines(sys.stderr), "mininterval": every, "delay": every, "ascii": True, "ncols": 100}
    return tqdm(**options)


class _Lines:
    """Writes each state of a bar as a line of its own."""

    def __init__(self, file: TextIO):
        self.file = file

    def write(self, text: str) -> None:
        """Writes text that is not blank."""
        text = text.strip()
        if text:
            self.file.write(f"{text}\n")

    def flush(self) -> None:
        """Lets readers see it."""
        self.file.flush()
