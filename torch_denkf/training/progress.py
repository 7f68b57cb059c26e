"""The progress bar, where tqdm and a terminal are."""

from __future__ import annotations

from typing import Any

try:  # of the extra "examples"
    from tqdm import tqdm
except ImportError:
    tqdm = None

__all__ = ["progress_bar"]


def progress_bar(name: str, total: int, done: int, shown: bool) -> Any:
    """A bar of ``total`` updates, of which ``done`` are made; a context manager.

    It stays silent unless ``shown``, tqdm is installed and stderr is a terminal.

    Example:
        >>> with progress_bar("fit", 10, 0, shown=False) as bar:
        ...     bar.set_postfix({"loss": 0.5}, refresh=False)
        ...     bar.update()
    """
    if tqdm is None or not shown:
        return _NoBar()
    return tqdm(total=total, initial=done, desc=name, disable=None)


class _NoBar:
    """Stands in for tqdm."""

    def __enter__(self) -> _NoBar:
        return self

    def __exit__(self, *_) -> None:
        pass

    def set_postfix(self, *_, **__) -> None:
        """Shows nothing."""

    def update(self) -> None:
        """Counts nothing."""
