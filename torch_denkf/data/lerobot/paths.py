"""Paths that a data set names: they stay in its folder, whoever wrote them."""

from __future__ import annotations

from pathlib import Path

__all__ = ["stay_inside"]


def stay_inside(root: Path, path: str, source: str) -> Path:
    """A path below a folder, as metadata name it.

    Args:
        root: the folder.
        path: relative to it.
        source: what names the path, for the message.

    Raises:
        ValueError: if it is absolute and elsewhere, or leads out of the folder.
    """
    file = root / path
    if ".." in Path(path).parts or not file.is_relative_to(root) or "\0" in path:
        raise ValueError(
            f"{source} names a file outside of the data set, {path!r}; such a data set may read anything of yours: "
            "download it from where you trust it, or correct the path"
        )
    return file
