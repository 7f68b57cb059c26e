"""Tables of rows: as CSV, and in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import pandas as pd

from torch_denkf.deployment.files import replacing, write_text


def pick(rows: Iterable[dict], **wanted) -> list[dict]:
    """Returns rows with these entries."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def line(*cells: object) -> str:
    """Returns a line of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*titles: object) -> list[str]:
    """Returns the first two lines of a Markdown table."""
    return [line(*titles), "|" + "---|" * len(titles)]


def markdown(frame: pd.DataFrame) -> list[str]:
    """Returns a Markdown table of a frame's index and columns; missing values are empty."""
    frame = frame.reset_index()
    return [*head(*frame.columns), *(line(*row) for row in frame.astype(object).where(frame.notna(), "").to_numpy())]


def write_table(
    rows: Iterable[dict], file: Path, order: Sequence[str], columns: Sequence[str] | None = None
) -> pd.DataFrame:
    """Writes rows as CSV with five digits, sorted by some columns if any; returns them as written."""
    frame = pd.DataFrame(rows, columns=columns).convert_dtypes()
    present = [key for key in order if key in frame]
    frame = frame.sort_values(present, kind="stable") if present else frame
    with replacing(file) as beside:
        frame.to_csv(beside, index=False, float_format="%.5g")
    return pd.read_csv(file)


def records(file: Path) -> list[dict]:
    """Returns rows of a CSV without its empty cells; no rows if there is no file."""
    rows = pd.read_csv(file).to_dict("records") if file.exists() else []
    return [{key: value for key, value in row.items() if pd.notna(value)} for row in rows]


def write_page(page: str, file: Path | None) -> None:
    """Prints a page, and writes it to a file if one is given."""
    print("\n" + page)
    if file is not None:
        write_text(file, page)


def report(
    folder: Path | None,
    rows: Sequence[dict],
    page: str,
    name: str = "table",
    order: Sequence[str] = (),
    columns: Sequence[str] | None = None,
) -> None:
    """Prints a page; writes it and the rows as NAME.md and NAME.csv in a folder if one is given."""
    if folder is not None:
        write_table(rows, folder / f"{name}.csv", order, columns)
    write_page(page, None if folder is None else folder / f"{name}.md")
