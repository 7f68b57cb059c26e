"""Reads numbers and lines of text files."""

from __future__ import annotations

from pathlib import Path

__all__ = ["read_lines", "read_number"]


def read_number(text: str) -> float:
    """Converts a text to a number; ``1_3`` raises, although Python reads 13.

    Raises:
        ValueError: if it is no number.
    """
    if "_" in text:
        raise ValueError(f"could not convert string to float: {text!r}")
    return float(text)


def read_lines(file: Path) -> list[str]:
    """Returns the lines of a text file in UTF-8.

    Raises:
        ValueError: if it is not UTF-8; the message names the file and the line.
    """
    data = file.read_bytes()
    try:
        return data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        byte = data[error.start]
        raise ValueError(
            f"{file}:{line} is no text in UTF-8 (byte 0x{byte:02x}); is the file compressed or damaged? Download or "
            "copy it again, or convert it to UTF-8"
        ) from error
