"""``denkf orient``."""

import numpy as np
import pytest

from tests.applications.imu.test_filter import body_log
from torch_denkf.applications.imu.commands import read_log
from torch_denkf.cli.main import main
from torch_denkf.functional.manifolds import SO3


def write_csv(file, table):
    names = ["t", "gx", "gy", "gz", "ax", "ay", "az", "mx", "my", "mz"][: table.shape[1]]
    np.savetxt(file, table, delimiter=",", header=",".join(names), comments="", fmt="%.9f")


@pytest.fixture(name="log", params=["npz", "csv"])
def log_of(request, tmp_path):
    truth, values = body_log(500)
    values = {name: value.numpy() for name, value in values.items()}
    file = tmp_path / f"walk.{request.param}"
    if request.param == "npz":
        np.savez(file, **values, rate=100.0)
    else:
        table = np.concatenate([np.arange(500)[:, None] / 100.0, *values.values()], -1)
        write_csv(file, table)
    return file, truth


def test_command_writes_orientations_and_a_picture(log, tmp_path, capsys):
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


def test_invalid_logs_raise(tmp_path, capsys):
    np.savez(tmp_path / "a.npz", gyro=np.zeros((9, 3)))
    assert main(["orient", "--log", str(tmp_path / "a.npz"), "--out", str(tmp_path / "out")]) == 2
    assert "lacks ['acceleration', 'rate']" in capsys.readouterr().err
    (tmp_path / "b.csv").write_text("t,gx\n0,1\n1,2\n")
    with pytest.raises(ValueError, match="needs the columns t, gx"):
        read_log(tmp_path / "b.csv")


#: Rows and columns of the table t, gx, gy, gz, ax, ay, az, mx, my, mz, and their damaged values.
DAMAGES = {
    "acceleration in g": ([np.s_[:, 4:7]], lambda part: part / 9.81, "acceleration is in m/s^2"),
    "degrees a second": ([np.s_[:, 1:4]], np.rad2deg, "multiply them by pi / 180"),
    "magnetometer in gauss": ([np.s_[:, 7:]], lambda part: 0.01 * part, "magnetometer is in uT"),
    "NaN gyro": ([np.s_[250, 1:4]], lambda part: np.nan, "gyro has readings that are not finite"),
    "constant stamps": ([np.s_[:, 0]], lambda part: 3.0, "to be even"),
    "stamps that go back": ([np.s_[250:, 0]], lambda part: part - 2.0, "to be even"),
    "NaN stamp": ([np.s_[250, 0]], lambda part: np.nan, "to be even"),
    "stamps in milliseconds": ([np.s_[:, 0]], lambda part: 1000 * part, "not in ms"),
    "an uneven stamp": ([np.s_[490:, 0]], lambda part: part + 3.0, "to be even"),
    "two axes of a magnetometer": ([], 9, "has mx, my but not all three"),
    "NaN accelerometer and magnetometer": ([np.s_[50:60, 4:7], np.s_[200:260, 7:]], lambda part: np.nan, None),
    "NaN magnetometer": ([np.s_[:, 7:]], lambda part: np.nan, None),
    "no magnetometer": ([], 7, None),
}


@pytest.mark.parametrize("what", DAMAGES)
def test_damaged_logs_raise_or_are_right(what, tmp_path, capsys):
    truth, values = body_log(500)
    table = np.concatenate([np.arange(500)[:, None] / 100.0, *values.values()], -1)
    places, change, message = DAMAGES[what]
    for place in places:
        table[place] = change(table[place])
    table = table if places else table[:, :change]
    write_csv(tmp_path / "log.csv", table)
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


@pytest.mark.parametrize("log", ["csv"], indirect=True)
def test_later_readings_count(log, tmp_path):
    """The smoothed heading has a smaller variance in the middle of a log, and the same at its end."""
    pytest.importorskip("matplotlib")
    stds = []
    for number, more in enumerate(([], ["--smooth"])):
        out = tmp_path / str(number)
        assert main(["orient", "--log", str(log[0]), "--out", str(out), *more]) == 0
        stds.append(np.genfromtxt(out / "orientation.csv", delimiter=",", names=True)["std_heading_deg"])
    assert (stds[1][:300] < 0.9 * stds[0][:300]).mean() > 0.9
    assert stds[1][-1] == pytest.approx(stds[0][-1], rel=1e-3)
