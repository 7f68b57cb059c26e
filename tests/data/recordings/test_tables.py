"""Tables as others write them."""

import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest

from torch_denkf.data import Table

GOOD = "time,x,y\n0.0,0,10\n0.1,1,11\n0.2,2,12\n"


def read(tmp_path, text, name="run.csv", **options):
    file = tmp_path / name
    file.write_bytes(text.encode())
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
    ],
)
def test_columns_that_are_read(tmp_path, text, options):
    readings = read(tmp_path, text, **options)
    np.testing.assert_array_equal(readings.times, [0, 0.1, 0.2])
    np.testing.assert_array_equal(readings.values[:, 0], [0, 1, 2])


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


def test_parquet_with_dates(tmp_path):
    times = pa.array([1_500_000, 1_700_000], pa.timestamp("us"))
    parquet.write_table(pa.table({"time": times, "x": [1, 2]}), tmp_path / "run.parquet")
    np.testing.assert_allclose(Table(tmp_path / "run.parquet").read().times, [1.5, 1.7], rtol=1e-12)
