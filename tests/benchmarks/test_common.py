"""Tests what the studies share: options, jobs that are done once, rows that survive their file."""

from functools import partial

import pytest

from benchmarks.common.jobs import once, read_rows
from benchmarks.common.tables import head, line, markdown, pick, records, write_table


def test_a_job_is_done_once_and_leaves_nothing_half(tmp_path):
    file, calls = tmp_path / "rows" / "a.json", []

    def rows(fails):
        calls.append(fails)
        if fails:
            raise KeyboardInterrupt
        return [{"value": 1.5}]

    with pytest.raises(KeyboardInterrupt):
        once(file, partial(rows, True))
    assert not file.exists()
    once(file, partial(rows, False))
    once(file, partial(rows, False))
    assert calls == [True, False]
    assert read_rows([file]) == [{"value": 1.5}]
    file.write_text(file.read_text()[:-4])
    with pytest.raises(ValueError, match=r"a\.json is damaged .* remove it"):
        read_rows([file])


def test_rows_are_picked_and_lined_up():
    rows = [{"name": "b", "seed": 2}, {"name": "a", "seed": 1}]
    assert pick(rows, name="a") == rows[1:]
    assert [*head("a", 5), line(1, "x")] == ["| a | 5 |", "|---|---|", "| 1 | x |"]


def test_table_of_mixed_columns_round_trip(tmp_path):
    rows = [{"name": "b", "seed": 2, "error": 1 / 3, "count": 123456}, {"name": "a", "seed": 1}]
    frame = write_table(rows, tmp_path / "table.csv", ("name",))
    assert (tmp_path / "table.csv").read_text() == "name,seed,error,count\na,1,,\nb,2,0.33333,123456\n"
    assert markdown(frame.set_index("name")) == [
        "| name | seed | error | count |",
        "|---|---|---|---|",
        "| a | 1 |  |  |",
        "| b | 2 | 0.33333 | 123456.0 |",
    ]
    assert records(tmp_path / "table.csv") == [
        {"name": "a", "seed": 1},
        {"name": "b", "seed": 2, "error": 0.33333, "count": 123456},
    ]
    assert records(tmp_path / "none.csv") == []
