"""Tables as others write them: what is read, and what is refused with its place."""

import time

import numpy as np
import pytest

from torch_denkf.data import Table

GOOD = "time,x,y\n0.0,0,10\n0.1,1,11\n0.2,2,12\n"


def read(tmp_path, text, name="run.csv", encoding="utf-8", **options):
    file = tmp_path / name
    file.write_bytes(text.encode(encoding))
    return Table(file, **options).read()


@pytest.mark.parametrize(
    ("text", "options"),
    [
        ("\ufeff" + GOOD, {}),
        (GOOD.replace("\n", "\r\n"), {}),
        (GOOD.replace(",", "\t"), {"name": "run.tsv"}),
        ("\n" + GOOD.replace("0.1", "\n   \n,,\n0.1") + ",,\n", {}),  # lines without anything
        (GOOD.replace(",10", ",10,"), {}),
        (GOOD.replace("x,y", " x , y"), {}),
        (GOOD.replace("y", "größe"), {"name": "ü 漢字.csv"}),
        (GOOD.replace("x,y", "x,y,y").replace("0,10", "0,10,3"), {"columns": ["x"]}),
        (GOOD.replace(",", ";"), {}),
        (GOOD.replace(",", "\t"), {}),
        ("# a run\n" + GOOD, {}),
        (GOOD.replace("x,y", "x,x"), {}),
    ],
)
def test_what_is_read(tmp_path, text, options):
    readings = read(tmp_path, text, **options)
    np.testing.assert_array_equal(readings.times, [0, 0.1, 0.2])
    np.testing.assert_array_equal(readings.values[:, 0], [0, 1, 2])


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (GOOD.split("\n", 1)[1], "its first line must name the columns, or pass columns= with 3 names"),
        ("time\n0\n1\n", "has no column to read beside 'time'"),
        (GOOD.replace("1,11", "1,11,5"), r"run.csv:3: 4 cells for 3 columns; write decimals with points"),
        (GOOD.replace("11", "1_1"), r"run.csv:3: 'y' is '1_1'"),
        (GOOD.replace("11", "1e39"), r"run.csv:3: 'y' is '1e39'"),  # infinite in float32
        (GOOD.replace("11", "nan"), r"run.csv:3: 'y' is 'nan'"),
        (GOOD.replace("0.1", "1_0"), r"run.csv:3: 'time' is '1_0'"),
        (GOOD.replace("0.2", "0.05"), r"run.csv:4: 'time' goes from 0.1 to 0.05 s"),
        ("t,time,x\n0,1700000000.25,1\n0,1700000000.125,2\n", "from 1700000000.25 to 1700000000.125 s"),
    ],
)
def test_what_is_refused(tmp_path, text, match):
    with pytest.raises(ValueError, match=match):
        read(tmp_path, text)


@pytest.mark.slow
def test_many_columns_take_no_longer_than_their_number(tmp_path):
    """A pass over all columns for each of them would take 20 minutes."""
    count = 200_000
    rows = (["time", *(f"c{k}" for k in range(count))], *([str(row + k) for k in range(count + 1)] for row in range(2)))
    started = time.monotonic()
    readings = read(tmp_path, "\n".join(map(",".join, rows)))
    assert time.monotonic() - started < 60
    np.testing.assert_array_equal(readings.values, np.arange(2)[:, None] + np.arange(1, count + 1))
    assert readings.columns[-1] == f"c{count - 1}"


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1"])
def test_other_encodings_are_refused_with_the_file(tmp_path, encoding):
    with pytest.raises(ValueError, match=r"run.csv is no text in UTF-8 .*store it again"):
        read(tmp_path, GOOD.replace("y", "größe"), encoding=encoding)


def test_parquet_with_dates(tmp_path):
    pyarrow = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    times = pyarrow.array([1_500_000, 1_700_000], pyarrow.timestamp("us"))
    parquet.write_table(pyarrow.table({"time": times, "x": [1, 2]}), tmp_path / "run.parquet")
    np.testing.assert_allclose(Table(tmp_path / "run.parquet").read().times, [1.5, 1.7], rtol=1e-12)
