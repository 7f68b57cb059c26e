"""Tables in parquet files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torch_denkf.data.video import EXTRA

__all__ = ["read_parquet"]


def read_parquet(file: Path, columns: Sequence[str] | None = None) -> Any:
    """Columns of a parquet file, or all, as a pyarrow table.

    Raises:
        ImportError: without pyarrow.
        FileNotFoundError: without the file.
        ValueError: if it is damaged, or lacks a column.
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
            return opened.read(None if columns is None else list(columns))
    except (arrow.ArrowException, OSError) as error:
        raise ValueError(f"{file} is no complete parquet file ({error}); download or copy it anew") from error
