"""``denkf orient``."""

import numpy as np
import pytest

from tests.applications.imu.test_filter import body_log
from torch_denkf.applications.imu.commands import read_log
from torch_denkf.cli.main import main
from torch_denkf.functional.manifolds import SO3


@pytest.fixture(name="log", params=["npz", "csv"])
def log_of(request, tmp_path):
    truth, values = body_log(500)
    values = {name: value.numpy() for name, value in values.items()}
    file = tmp_path / f"walk.{request.param}"
    if request.param == "npz":
        np.savez(file, **values, rate=100.0)
    else:
        table = np.concatenate([np.arange(500)[:, None] / 100.0, *values.values()], -1)
        np.savetxt(file, table, delimiter=",", header="t,gx,gy,gz,ax,ay,az,mx,my,mz", comments="", fmt="%.9f")
    return file, truth


def test_it_writes_orientations_and_a_picture(log, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    file, truth = log
    assert main(["orient", "--log", str(file), "--out", str(tmp_path / "out")]) == 0
    assert "500 orientations" in capsys.readouterr().out
    table = np.genfromtxt(tmp_path / "out" / "orientation.csv", delimiter=",", names=True)
    assert table.dtype.names == ("t", "w", "x", "y", "z", "std_x_deg", "std_y_deg", "std_heading_deg")
    assert table["t"][-1] == pytest.approx(4.99)
    found = truth.new_tensor(np.stack([table[name] for name in "wxyz"], -1))
    away = SO3().log(SO3().compose(found, SO3().inverse(truth)))[300:].rad2deg()
    assert away[:, :2].abs().max() < 3
    assert table["std_heading_deg"].min() > table["std_x_deg"].min() > 0
    assert (tmp_path / "out" / "orientation.png").read_bytes()[:4] == b"\x89PNG"


def test_logs_that_are_none(tmp_path, capsys):
    np.savez(tmp_path / "a.npz", gyro=np.zeros((9, 3)))
    assert main(["orient", "--log", str(tmp_path / "a.npz"), "--out", str(tmp_path / "out")]) == 2
    assert "lacks ['acceleration', 'rate']" in capsys.readouterr().err
    (tmp_path / "b.csv").write_text("t,gx\n0,1\n1,2\n")
    with pytest.raises(ValueError, match="needs the columns t, gx"):
        read_log(tmp_path / "b.csv")
    (tmp_path / "c.csv").write_text(
        "t,gx,gy,gz,ax,ay,az\n0,0,0,0,0,0,9.8\n1,0,0,0,0,0,9.8\n5,0,0,0,0,0,9.8\n6,0,0,0,0,0,9.8\n"
    )
    with pytest.raises(ValueError, match="to be even"):
        read_log(tmp_path / "c.csv")


def changed(values, what):
    """A damaged log."""
    values = {name: value.copy() for name, value in values.items()}
    if what == "units in g":
        values["acceleration"] /= 9.81
    elif what == "degrees a second":
        values["gyro"] *= 180 / np.pi
    elif what == "magnetometer in gauss":
        values["magnetometer"] *= 0.01
    elif what == "NaN gyro":
        values["gyro"][250] = np.nan
    elif what == "constant stamps":
        values["t"][:] = 3.0
    elif what == "stamps that go back":
        values["t"][250:] -= 2.0
    elif what == "NaN stamp":
        values["t"][250] = np.nan
    elif what == "two axes of a magnetometer":
        values["magnetometer"] = values["magnetometer"][:, :2]
    elif what == "NaN accelerometer and magnetometer":
        values["acceleration"][50:60] = values["magnetometer"][200:260] = np.nan
    elif what == "NaN magnetometer":
        values["magnetometer"][:] = np.nan
    elif what == "no magnetometer":
        del values["magnetometer"]
    return values


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("units in g", "acceleration is in m/s^2"),
        ("degrees a second", "multiply them by pi / 180"),
        ("magnetometer in gauss", "magnetometer is in uT"),
        ("NaN gyro", "gyro has readings that are not finite"),
        ("constant stamps", "to be even"),
        ("stamps that go back", "to be even"),
        ("NaN stamp", "to be even"),
        ("two axes of a magnetometer", "has mx, my but not all three"),
        ("NaN accelerometer and magnetometer", None),
        ("NaN magnetometer", None),
        ("no magnetometer", None),
    ],
)
def test_damaged_logs_raise_or_are_right(what, message, tmp_path, capsys):
    truth, values = body_log(800)
    values = {"t": np.arange(800)[:, None] / 100.0, **{name: value.numpy() for name, value in values.items()}}
    values = changed(values, what)
    table = np.concatenate([*values.values()], -1)
    names = ",".join(["t", "gx", "gy", "gz", "ax", "ay", "az", "mx", "my", "mz"][: table.shape[1]])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=names, comments="")
    status = main(["orient", "--log", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")])
    if message is not None:
        assert status == 2
        assert message in capsys.readouterr().err
        return
    assert status == 0
    table = np.genfromtxt(tmp_path / "out" / "orientation.csv", delimiter=",", names=True)
    found = truth.new_tensor(np.stack([table[name] for name in "wxyz"], -1))
    away = SO3().log(SO3().compose(found, SO3().inverse(truth)))[300:].rad2deg()
    away = away if what.startswith("NaN acc") else away - away.mean(0)  # without a magnetometer the heading is relative
    assert away.abs().max() < 4


def test_later_readings_count(log, tmp_path):
    """In the middle of a log the smoothed heading is known better, at its end as well."""
    pytest.importorskip("matplotlib")
    stds = []
    for number, more in enumerate(([], ["--smooth"])):
        out = tmp_path / str(number)
        assert main(["orient", "--log", str(log[0]), "--out", str(out), *more]) == 0
        stds.append(np.genfromtxt(out / "orientation.csv", delimiter=",", names=True)["std_heading_deg"])
    assert (stds[1][:300] < 0.9 * stds[0][:300]).mean() > 0.9
    assert stds[1][-1] == pytest.approx(stds[0][-1], rel=1e-3)


def test_stamps_in_milliseconds(log, tmp_path, capsys):
    if log[0].suffix == ".csv":
        head, *rows = log[0].read_text().splitlines()
        scaled = [f"{1000 * float(row.split(',', 1)[0])},{row.split(',', 1)[1]}" for row in rows]
        (tmp_path / "ms.csv").write_text("\n".join([head, *scaled]))
        assert main(["orient", "--log", str(tmp_path / "ms.csv"), "--out", str(tmp_path / "out")]) == 2
        assert "not in ms" in capsys.readouterr().err
