"""Tables of rows: as CSV, and in Markdown."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev

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


def average(
    rows: Iterable[dict],
    column: str,
    form: str = "{:.2f}",
    of: Callable[[Iterable[float]], float] = mean,
    deviation: bool = False,
) -> str:
    """Returns a column's mean over rows, as text; empty where no row has the column.

    Args:
        rows: of several seeds.
        column: its name.
        form: of the number.
        of: the average.
        deviation: whether the standard deviation follows, where there are three values or more.
    """
    values = [row[column] for row in rows if column in row]
    if not values:
        return ""
    return form.format(of(values)) + (f" ± {form.format(stdev(values))}" if deviation and len(values) > 2 else "")


def covered(rows: Iterable[dict], column: str = "coverage90", of: Callable[[Iterable[float]], float] = mean) -> str:
    """Returns the average coverage, in percent."""
    return average([{"percent": 100 * row[column]} for row in rows], "percent", "{:.0f} %", of)


def grid(
    rows: Sequence[dict], keys: Sequence[str], cells: dict[str, Callable[[list[dict]], str]], titles: Sequence[str] = ()
) -> list[str]:
    """Returns a Markdown table with a line for each group of rows, in the order of the first of each.

    Args:
        rows: all of them.
        keys: columns by which rows are grouped, and that open a line.
        cells: functions of a group's rows, by title.
        titles: of the keys, by default their names.
    """
    groups: dict[tuple, list[dict]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    lines = [line(*names, *(cell(own) for cell in cells.values())) for names, own in groups.items()]
    return [*head(*(titles or keys), *cells), *lines]


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
