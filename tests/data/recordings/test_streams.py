"""The streams of a log: columns that are empty in other rows, or never change, and what is in no stream."""

import numpy as np
import pytest

from torch_denkf.cli.main import main
from torch_denkf.data import Table
from torch_denkf.data.recordings.streams import streams_of


def test_blank_cells_are_streams_of_their_own(tmp_path, capsys):
    """Fixes and turn rates of two rates in one file, with a column that has a number in each row."""
    rows = [f"{0.1 * k:.1f},{20 + 0.01 * k:.2f},{k % 7},{k},ok" for k in range(40)]
    rows[1::2] = [f"{0.1 * k:.1f},{20 + 0.01 * k:.2f},,,ok" for k in range(1, 40, 2)]
    rows = [f"{row},{'' if k % 2 == 0 else k % 5}" for k, row in enumerate(rows)]
    (tmp_path / "log.csv").write_text("\n".join(["t,temp,x,y,state,yaw_rate", *rows]) + "\n")
    streams = streams_of(tmp_path / "log.csv")
    assert {name: stream.readings.columns for name, stream in streams.items()} == {
        "temp": ("temp",),
        "position": ("x", "y"),
        "imu": ("yaw_rate",),
    }
    np.testing.assert_allclose(streams["position"].readings.times, 0.1 * np.arange(0, 40, 2))
    np.testing.assert_allclose(streams["imu"].readings.values[:, 0], np.arange(1, 40, 2) % 5)
    assert main(["log", str(tmp_path / "log.csv"), "--time", "t"]) == 0
    assert "position: 20 readings, 5 Hz: x, y" in capsys.readouterr().out
    with pytest.raises(ValueError, match=r"tables of their own: pass columns=\['x'\]"):
        Table(tmp_path / "log.csv", ["temp", "x"]).read()


def test_missing_values_of_parquet_are_blank_cells(tmp_path):
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    time, some = 0.1 * np.arange(40), np.arange(40) % 2 == 0
    fixes = [value if seen else None for value, seen in zip(np.sin(time).tolist(), some, strict=True)]
    table = {"t": time, "x": fixes, "y": fixes, "speed": np.cos(time)}
    parquet.write_table(pyarrow.table(table), tmp_path / "log.parquet")
    streams = streams_of(tmp_path / "log.parquet")
    assert {name: stream.readings.columns for name, stream in streams.items()} == {
        "speed": ("speed",),
        "position": ("x", "y"),
    }
    np.testing.assert_allclose(streams["position"].readings.times, time[some])


def test_columns_that_never_change(tmp_path, capsys):
    """One of a place's two is kept, with what it is; others are named."""
    time = np.arange(0, 20, 0.1)
    table = np.c_[time, np.sin(time), np.zeros_like(time), np.full_like(time, 3.0)]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,x [m],y [m],heading", comments="")
    (stream,) = streams_of(tmp_path / "log.csv").values()
    assert (stream.readings.columns, stream.others) == (("x [m]", "y [m]"), ("heading",))
    assert main(["log", str(tmp_path / "log.csv")]) == 0
    out = capsys.readouterr().out
    assert "y [m] is always 0" in out
    assert "not used, as they are constant or change at other times than the sensors: heading" in out
