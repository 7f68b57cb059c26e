"""Tables in parquet files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch_denkf.data.video import EXTRA

__all__ = ["parquet_names", "read_parquet"]

MOST_ROWS = 10**8
MOST_BYTES, MOST_RATIO = 1 << 30, 64  # a larger table is at most so many times the file's size


def read_parquet(file: Path, columns: Sequence[str] | None = None) -> Any:
    """Returns columns of a parquet file, or all, as a pyarrow table.

    Raises:
        ImportError: without pyarrow.
        FileNotFoundError: without the file.
        ValueError: if it is damaged, lacks a column, or announces far more data than its size allows.
    """
    try:
        import pyarrow as arrow
        import pyarrow.parquet as parquet
    except ImportError as error:
        raise ImportError(f"{file} is a parquet file, which needs pyarrow: {EXTRA}") from error
    if not file.is_file():
        raise FileNotFoundError(f"no table {file}; check the path")
    try:
        with parquet.ParquetFile(file) as opened:
            there = opened.schema_arrow.names
            missing = sorted(set(columns or ()) - set(there))
            if missing:
                raise ValueError(f"{file} lacks the columns {missing}; it has {there}")
            _check_unpacked_size(file, opened.metadata)
            return opened.read(None if columns is None else list(columns))
    except (arrow.ArrowException, OSError) as error:
        raise ValueError(f"{file} is no complete parquet file ({error}); download or copy it again") from error


def parquet_names(file: Path) -> list[str]:
    """Returns the names of a parquet file's columns; raises as :func:`read_parquet`."""
    read_parquet(file, [])
    import pyarrow.parquet as parquet

    return list(parquet.read_schema(file).names)


def _check_unpacked_size(file: Path, metadata: Any) -> None:
    """Raises for decompression bombs, before anything is unpacked.

    Raises:
        ValueError: for a small file that announces a huge table.
    """
    size = sum(metadata.row_group(group).total_byte_size for group in range(metadata.num_row_groups))
    if metadata.num_rows > MOST_ROWS or size > max(MOST_BYTES, MOST_RATIO * file.stat().st_size):
        raise ValueError(
            f"{file} has {file.stat().st_size} bytes and announces {metadata.num_rows} rows of together {size} bytes; "
            "that much is not unpacked: download or copy it again"
        )
