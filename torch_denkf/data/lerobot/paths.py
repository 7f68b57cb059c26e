"""Paths that a data set's metadata name: they stay in its folder, whoever wrote them."""

from __future__ import annotations

import re
from pathlib import Path
from string import Formatter
from typing import Any

__all__ = ["fill_in", "stay_inside"]

_WIDTH = re.compile(r"0?\d{0,2}d?")  # of a number in a template


def fill_in(root: Path, template: str, place: dict[str, Any]) -> Path:
    """A path of the metadata, filled in.

    Raises:
        ValueError: if it leads out of the folder, or is no template of LeRobot's.
    """
    try:
        parts = list(Formatter().parse(template))
        fields = {field for _, field, _, _ in parts if field is not None}
        widths = [spec for _, _, spec, _ in parts if spec]
        if not fields <= set(place) or any(not _WIDTH.fullmatch(spec) for spec in widths):
            raise ValueError(f"it may name {sorted(place)}, with widths such as 06d")
        path = template.format(**place)
    except (ValueError, KeyError, IndexError, TypeError, AttributeError) as error:
        raise ValueError(
            f"{root / 'meta' / 'info.json'} has a path {template!r} that cannot be filled in: {error}"
        ) from error
    return stay_inside(root, path, str(root / "meta" / "info.json"))


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
