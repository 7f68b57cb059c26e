"""Progress of long tasks: a bar in a terminal, periodic lines elsewhere."""

from __future__ import annotations

import sys
from typing import Any, TextIO

from tqdm import tqdm

__all__ = ["progress_bar"]

SECONDS = 10.0  # between two lines without a terminal; shorter tasks write none


def progress_bar(
    name: str, total: int | None, done: int = 0, *, unit: str = "it", shown: bool = True, every: float = SECONDS
) -> Any:
    """Returns tqdm's progress bar over ``total`` items, of which ``done`` are finished, as a context manager.

    Without a terminal, as in a log file, a line is written to stderr every ten seconds, or at another interval.

    Args:
        name: name of the task.
        total: number of items; ``None`` if unknown.
        done: number of finished items.
        unit: unit of the items.
        shown: whether to show progress.
        every: seconds between two lines without a terminal.

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
    """Writes each state of a progress bar as a separate line."""

    def __init__(self, file: TextIO):
        self.file = file

    def write(self, text: str) -> None:
        """Writes text that is not blank."""
        text = text.strip()
        if text:
            self.file.write(f"{text}\n")

    def flush(self) -> None:
        """Flushes the file."""
        self.file.flush()
