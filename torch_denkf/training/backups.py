"""Backups of files of an earlier training."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

__all__ = ["back_up"]

_LOG = logging.getLogger("torch_denkf")


def back_up(out: Path, files: Sequence[Path]) -> None:
    """Moves files below a training's folder to ``out/earlier-1``, or the next free number, and logs it.

    Args:
        out: the folder.
        files: files below it; their relative paths are kept.

    Example:
        >>> import tempfile
        >>> out = Path(tempfile.mkdtemp())
        >>> (out / "best_fit.pt").touch()
        >>> back_up(out, [out / "best_fit.pt"])
        >>> (out / "earlier-1" / "best_fit.pt").is_file()
        True
    """
    if not files:
        return
    taken = [folder.name.removeprefix("earlier-") for folder in out.glob("earlier-*")]
    aside = out / f"earlier-{1 + max((int(number) for number in taken if number.isdecimal()), default=0)}"
    for file in files:
        place = aside / file.relative_to(out)
        place.parent.mkdir(parents=True, exist_ok=True)
        file.rename(place)
    _LOG.warning("%s has no last.pt, but other files of an earlier training: they are now in %s", out, aside)
