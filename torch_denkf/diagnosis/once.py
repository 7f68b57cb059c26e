"""A warning that is given once."""

from __future__ import annotations

import warnings

from torch_denkf.filters.finish import RUNS

__all__ = ["Once"]


class Once:
    """Gives each warning once; the base of a filter's observers.

    Attributes:
        said: what was warned of.

    Example:
        >>> class Diverging(Once):
        ...     def __call__(self, filter, record):
        ...         if (record.written["belief", "var"] > 1e6).any():
        ...             self.warn("variance", f"{type(filter).__name__} knows nothing of its state.")
    """

    #: The ways to run that it looks at.
    ways: tuple[str, ...] = RUNS

    def __init__(self) -> None:
        self.said: set[str] = set()

    def warn(self, about: str, text: str) -> None:
        """Warns the first time that ``about`` comes up."""
        if about not in self.said:
            self.said.add(about)
            warnings.warn(f"{text} Said once.", stacklevel=6)
