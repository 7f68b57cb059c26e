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
