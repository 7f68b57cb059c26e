"""Tables of rows: as CSV, and in Markdown."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from torch_denkf.deployment.files import replacing, write_text


@dataclass(frozen=True)
class Columns:
    """A CSV file of rows.

    Args:
        names: of all columns.
        text: those that hold text.
        whole: those that hold whole numbers; all others hold floats, of which five digits are kept.
        order: sorts the rows.
    """

    names: Sequence[str]
    text: Sequence[str]
    whole: Sequence[str]
    order: Callable[[dict], tuple]

    def write(self, rows: Iterable[dict], file: Path) -> None:
        """Writes rows; NaN and what a row lacks stay empty."""
        with replacing(file) as beside, beside.open("w", newline="") as stream:
            writer = csv.DictWriter(stream, self.names, lineterminator="\n")
            writer.writeheader()
            for row in sorted(rows, key=self.order):
                writer.writerow({k: f"{v:.5g}" if isinstance(v, float) else v for k, v in row.items() if v == v})

    def read(self, file: Path) -> list[dict]:
        """Rows as :meth:`write` wrote them; what is empty is left out.

        Raises:
            ValueError: if the file has other columns.
        """
        with file.open(newline="") as stream:
            reader = csv.DictReader(stream)
            rows, columns = list(reader), list(reader.fieldnames or [])
        if columns != list(self.names):
            found = ", ".join(columns) or "no columns"
            raise ValueError(f"{file} has {found}, not the columns {', '.join(self.names)}")
        kinds = {**dict.fromkeys(self.names, float), **dict.fromkeys(self.text, str), **dict.fromkeys(self.whole, int)}
        return [{key: kinds[key](value) for key, value in row.items() if value} for row in rows]


def pick(rows: Iterable[dict], **wanted) -> list[dict]:
    """Rows with these entries."""
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def line(*cells: object) -> str:
    """A line of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def head(*titles: object) -> list[str]:
    """The two lines that a Markdown table begins with."""
    return [line(*titles), "|" + "---|" * len(titles)]


def markdown(frame: pd.DataFrame) -> list[str]:
    """Returns a Markdown table of a frame's index and columns; missing values are empty."""
    frame = frame.reset_index()
    return [*head(*frame.columns), *(line(*row) for row in frame.astype(object).where(frame.notna(), "").to_numpy())]


def write_table(rows: Iterable[dict], file: Path, order: Sequence[str]) -> pd.DataFrame:
    """Writes rows as CSV with five digits, sorted by some columns if any; returns them as they are there."""
    frame = pd.DataFrame(rows).convert_dtypes()
    frame = frame.sort_values(list(order), kind="stable") if order else frame
    with replacing(file) as beside:
        frame.to_csv(beside, index=False, float_format="%.5g")
    return pd.read_csv(file)


def records(file: Path) -> list[dict]:
    """Rows of a CSV, without what is empty; none where there is no file."""
    rows = pd.read_csv(file).to_dict("records") if file.exists() else []
    return [{key: value for key, value in row.items() if pd.notna(value)} for row in rows]


def write_page(page: str, file: Path | None) -> None:
    """Prints a page, and leaves it in a file if one is given."""
    print("\n" + page)
    if file is not None:
        write_text(file, page)


def report(folder: Path | None, columns: Columns, rows: Sequence[dict], page: str, name: str = "table") -> None:
    """Prints a page; leaves it and the rows as NAME.md and NAME.csv in a folder if one is given."""
    if folder is not None:
        columns.write(rows, folder / f"{name}.csv")
    write_page(page, None if folder is None else folder / f"{name}.md")
