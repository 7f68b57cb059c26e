"""From a log to a path: what sensors read of the states, rows, learned noises, the command."""

import json

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from tests.data.recordings.cart import cart, write_cart
from tests.real_data import SHARED
from torch_denkf.applications.robot import robot_model
from torch_denkf.applications.robot.config import read_config
from torch_denkf.applications.robot.learning import learn_noises, scale_of
from torch_denkf.applications.robot.log import (
    default_settings,
    drift_settings,
    log_streams,
    read_log,
    rows_of_log,
    start_of,
)
from torch_denkf.applications.robot.readings import seen_by
from torch_denkf.cli.main import main
from torch_denkf.data.earth import to_degrees
from torch_denkf.data.recordings.tables import Readings

ORIGIN = (51.04, 13.79)


def flags(*places):
    return [place in places for place in range(15)]


def drive(seconds=60.0, seed=0):
    """Returns times at 20 Hz, positions, headings, speeds and turn rates of a car."""
    rng, dt = np.random.default_rng(seed), 0.05
    time = np.arange(0, seconds, dt)
    turn, speed = np.zeros(len(time)), np.full(len(time), 5.0)
    for k in range(1, len(time)):
        turn[k] = (1 - 0.3 * dt) * turn[k - 1] + 0.2 * dt**0.5 * rng.normal()
        speed[k] = 5 + (1 - 0.2 * dt) * (speed[k - 1] - 5) + 0.7 * dt**0.5 * rng.normal()
    summed = lambda rate: np.append(0, np.cumsum(rate[1:] + rate[:-1]) * dt / 2)  # noqa: E731
    heading = 0.5 + summed(turn)
    return time, np.c_[summed(speed * np.cos(heading)), summed(speed * np.sin(heading))], heading, speed, turn


def write_log(file, seconds=60.0):
    """Writes a wide log of a phone: degrees, km/h, and GPS fixes at 1 Hz that are repeated in between."""
    rng = np.random.default_rng(1)
    time, place, _, speed, turn = drive(seconds)
    fixes = place + 0.3 * rng.normal(size=place.shape)
    degrees = to_degrees(fixes, ORIGIN)[(np.arange(len(time)) // 20) * 20]
    gyro = np.degrees(turn + 0.02 * rng.normal(size=len(time)))
    table = np.c_[1.7e12 + 1e3 * time, gyro, 3.6 * speed + 0.3 * rng.normal(size=len(time)), degrees]
    head = "timestamp_ms,yaw_rate,speed,latitude,longitude"
    np.savetxt(file, table, fmt="%.9f", delimiter=",", header=head, comments="")
    return time, place


def test_messages_of_ros():
    """Quaternions, covariances, negative ones too, and gravity that leans with the body."""
    roll, pitch, yaw = 0.1, -0.2, 3.0
    quaternion = Rotation.from_euler("xyz", [roll, pitch, yaw]).as_quat()
    columns = [f"orientation.{axis}" for axis in "xyzw"]
    columns += [f"angular_velocity.{axis}" for axis in "xyz"] + [f"linear_acceleration.{axis}" for axis in "xyz"]
    columns += [f"angular_velocity_covariance.{k}" for k in range(9)]
    gravity = 9.8 * np.array([-np.sin(pitch), np.cos(pitch) * np.sin(roll), np.cos(pitch) * np.cos(roll)])
    row = [*quaternion, 0.1, 0.2, 0.3, *(gravity[0] + 1.0, *gravity[1:]), *np.diag([0.01, 0.02, -0.03]).reshape(-1)]
    table = Readings(np.array([0.0, 1.0]), np.array([row, row]), tuple(columns))
    settings = {"imu0": "/imu", "imu0_config": flags(3, 4, 5, 11, 12), "gravitational_acceleration": 9.8}
    config = read_config(settings | {"imu0_remove_gravitational_acceleration": True})
    (sensor,) = config.sensors
    pose, twist, force = (
        seen_by(sensor, group, config, table, None, 1.0) for group in ("pose", "twist", "acceleration")
    )
    np.testing.assert_allclose(pose.values[0], [roll, pitch, yaw], atol=1e-12)
    np.testing.assert_allclose(twist.values[0], [0.3])
    np.testing.assert_allclose(twist.noise[0], [[0.03]])
    np.testing.assert_allclose(force.values[0], [1.0], atol=1e-12)
    assert twist.stated
    assert not force.stated


def test_differential_poses_are_velocities_of_the_body():
    angle = np.array([3.0, 3.1, 3.2, 3.3]) + 0.05
    stem = "pose.pose."
    columns = (f"{stem}position.x", f"{stem}position.y", f"{stem}orientation.z", f"{stem}orientation.w")
    columns += (f"{stem}orientation.x", f"{stem}orientation.y")
    place = np.cumsum([[0.0, 0.0], *(0.2 * np.c_[np.cos(angle[:-1] + 0.05), np.sin(angle[:-1] + 0.05)])], 0)
    zero = np.zeros(4)
    values = np.c_[place, np.sin(angle / 2), np.cos(angle / 2), zero, zero]
    table = Readings(np.arange(4) * 0.1, values, columns)
    config = read_config({"odom0": "/o", "odom0_config": flags(0, 1, 5), "odom0_differential": True})
    seen = seen_by(config.sensors[0], "pose", config, table, None, 1.0)
    np.testing.assert_allclose(seen.values, [[2.0, 0.0, 1.0]] * 3, atol=1e-9)
    model = robot_model({"odom0": "/o", "odom0_config": flags(0, 1, 5), "odom0_differential": True})
    assert model.reads["odom0_pose"] == (6, 7, 11)


def test_a_state_that_the_log_lacks(tmp_path):
    write_log(tmp_path / "log.csv", 20.0)
    config = read_config({"imu0": "imu", "imu0_config": flags(5)})
    with pytest.raises(ValueError, match=r"imu0_config reads \['yaw'\], of which 'imu' has no column"):
        read_log(tmp_path / "log.csv", config, log_streams(tmp_path / "log.csv"))
    config = read_config({"imu0": "/other", "imu0_config": flags(11)})
    with pytest.raises(ValueError, match=r"has no stream '/other'; it has \['imu', 'speed', 'gps'\]: see denkf log"):
        read_log(tmp_path / "log.csv", config, log_streams(tmp_path / "log.csv"))


def planar(folder, seconds, **more):
    """Returns a log of fixes and a gyro, and the model that reads them."""
    write_log(folder / "log.csv", seconds)
    settings = {"two_d_mode": True, "frequency": 2.0, "initial_estimate_covariance": [1.0] * 15}
    settings |= {"pose0": "gps", "pose0_config": flags(0, 1), "imu0": "imu", "imu0_config": flags(11)}
    model = robot_model(settings | more)
    return read_log(folder / "log.csv", model.config, log_streams(folder / "log.csv")), model


def test_noises_that_are_learned_are_those_of_the_log(tmp_path):
    """From a hundred times too large to within a half, of a gyro and of fixes."""
    log, model = planar(tmp_path, 40.0, twist0="speed", twist0_config=flags(6, 7))
    model = start_of(log, robot_model(drift_settings(log, model)))
    rows = rows_of_log(log, model)
    torch.testing.assert_close(rows["twist0_twist"][5:, 0].mean().item(), 5.0, atol=1.0, rtol=0)
    learned = learn_noises(model, rows, steps=2, window=5.0, shown=False)
    assert learned.after > learned.before
    fixes = scale_of(model, "pose0_pose").detach().exp()
    assert ((fixes > 0.1) & (fixes < 0.9)).all()
    assert scale_of(model, "imu0_twist").exp() < 0.2
    torch.testing.assert_close(fixes[0], fixes[1])  # x and y alike
    assert scale_of(model, "twist0_twist")[1] == 0  # sideways all readings are zero, and say nothing of their noise
    with pytest.raises(ValueError, match=r"the log has 5 rows, too few to cut it into 4 segments: pass --steps 0"):
        learn_noises(model, rows[:5], steps=1, shown=False)


def test_interrupted_learning_keeps_its_result(tmp_path, monkeypatch):
    log, model = planar(tmp_path, 20.0)
    rows, calls = rows_of_log(log, model), []

    def likelihood(model, segments):
        calls.append(1)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return -scale_of(model, "imu0_twist").sum().square() + scale_of(model, "imu0_twist").sum()

    monkeypatch.setattr("torch_denkf.applications.robot.learning._likelihood", likelihood)
    learned = learn_noises(model, rows, steps=5, window=5.0, shown=False)
    assert learned.interrupted
    assert (learned.before, learned.after) == (0.0, pytest.approx(0.3 - 0.3**2))  # a step of Adam
    assert scale_of(model, "imu0_twist").item() == pytest.approx(0.3)


def test_two_files_of_a_boat(tmp_path):
    """Dates under a name of its own, semicolons, knots, a compass clockwise from north, an inertial sensor's gz."""
    time, place, heading, speed, turn = drive(30.0)
    stamp = [f"2025-06-01T09:30:{second:06.3f}" for second in time]
    degrees, compass = to_degrees(place, ORIGIN), (90 - np.degrees(heading)) % 360
    rows = [
        f"{stamp[k]};{degrees[k, 0]:.8f};{degrees[k, 1]:.8f};{speed[k] * 1.94384:.3f};{compass[k]:.2f}"
        for k in range(0, len(time), 20)
    ]
    head = "Zeit;Latitude;Longitude;SOG [kn];Compass heading [deg]"
    (tmp_path / "gps.csv").write_text("\n".join([head, *rows]) + "\n")
    rows = [f"{stamp[k]};{0.1 * k % 1:.3f};{turn[k]:.6f}" for k in range(len(time))]
    (tmp_path / "imu.csv").write_text("\n".join(["timestamp;gx;gz", *rows]) + "\n")
    streams = log_streams(tmp_path / "gps.csv", tmp_path / "imu.csv")
    assert list(streams) == ["speed", "gps", "imu"]
    settings = default_settings(streams)
    assert settings["pose0_config"] == flags(0, 1, 5)
    log = read_log("both", read_config(settings), streams)
    assert log.seen["pose0_pose"].times[0] == 1748770200.0
    yaw, slow = log.seen["pose0_pose"].values[:, 2], slice(0, None, 20)
    np.testing.assert_allclose(np.sin(yaw - heading[slow]), 0, atol=1e-3)
    np.testing.assert_allclose(np.cos(yaw - heading[slow]), 1, atol=1e-3)
    np.testing.assert_allclose(log.seen["twist0_twist"].values[:, 0], speed[slow], atol=1e-3)
    np.testing.assert_allclose(log.seen["imu0_twist"].values[:, 0], turn, atol=1e-5)
    with pytest.raises(ValueError, match="no log was given"):
        log_streams()


def test_units_in_names(tmp_path):
    """A slow turn in degrees, though small, one in rad, though unwrapped, and places in km."""
    time = np.arange(0, 20, 0.1)
    turn, place = 0.1 * np.sin(time), np.c_[time, np.sin(time)]
    head = "t,x [km],y [mm],heading [rad],yaw_rate [deg/s]"
    table = np.c_[time, place * [1e-3, 1e3], 0.5 * time, np.degrees(turn)]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=head, comments="")
    streams = log_streams(tmp_path / "log.csv")
    seen = read_log("log", read_config(default_settings(streams)), streams).seen
    np.testing.assert_allclose(seen["imu0_twist"].values[:, 0], turn, atol=1e-9)
    np.testing.assert_allclose(seen["pose0_pose"].values[:, :3], np.c_[place, 0.5 * time], atol=1e-9)


def test_a_pose_alone(tmp_path, capsys):
    """A heading next to x and y is read; a filter of one sensor has its distances without a name."""
    time = np.arange(0, 10, 0.1)
    circle = np.c_[time, np.sin(time), 1 - np.cos(time), (time + np.pi) % (2 * np.pi) - np.pi]
    np.savetxt(
        tmp_path / "pose.txt",
        circle + 1e-3 * np.random.default_rng(0).normal(size=circle.shape) * [0, 1, 1, 1],
        header="time x y theta",
    )
    assert main(["fuse", str(tmp_path / "pose.txt"), "--out", str(tmp_path / "out"), "--steps", "0"]) == 0
    assert "| pose0_pose (position) | x, y, yaw | " in capsys.readouterr().out


def fused(folder, capsys, share, *words):
    """Returns the error of a cart's path with so many outliers, the share of its 90 % intervals, the report."""
    folder.mkdir()
    logs, truth = write_cart(folder, *cart(60, share))
    assert main(["fuse", *logs, "--out", str(folder), *words]) == 0
    path = np.genfromtxt(folder / "path.csv", delimiter=",", names=True)
    off = np.c_[[path[name] - np.interp(path["time"], truth[:, 0], truth[:, k]) for k, name in ((1, "x"), (2, "y"))]]
    held = np.abs(off) < 1.645 * np.c_[[path["std_x"], path["std_y"]]]
    capsys.readouterr()
    return np.sqrt(np.square(off).sum(0).mean()), held.mean(), (folder / "report.md").read_text()


def test_outliers_of_fixes(tmp_path, capsys):
    """A tenth of fixes wrong by 3 m, no gyro: as good as without but for the fixes that are lost.

    Intervals may hold more: a log of a minute does not tell noise from drift.
    """
    clean, _, report = fused(tmp_path / "clean", capsys, 0.0, "--steps", "1")
    assert " | 0 | " in report.splitlines()[8]
    error, held, report = fused(tmp_path / "wrong", capsys, 0.1, "--steps", "1")
    wrong = cart(60, 0.1)[2].sum()
    assert f" | {wrong} | " in report.splitlines()[8]
    assert error < 1.5 * clean
    assert held > 0.8


def test_columns_that_are_not_used(tmp_path, capsys):
    """Says so, and that no place is known; without any sensor that is an error."""
    time, _, _, speed, _ = drive(20.0)
    table = np.c_[time, np.cumsum(speed) * 0.05, speed]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,position_m,wheel_speed", comments="")
    assert main(["fuse", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out"), "--steps", "0"]) == 0
    report, out = (tmp_path / "out/report.md").read_text(), capsys.readouterr().out
    for text in (report, out):
        assert "ot used: position_m" in text
        assert (
            "o position fixes: the path starts at the origin and drifts; names of position columns are latitude and"
            in text
        )
    np.savetxt(tmp_path / "log.csv", table[:, :2], delimiter=",", header="t,position_m", comments="")
    assert main(["fuse", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out")]) == 2
    assert "none of the columns ['position_m'] is known; names are latitude" in capsys.readouterr().err


def test_a_cart_on_an_axis(tmp_path, capsys):
    """The column that is always zero is read, and its noise not learned: a variance of zero has no logarithm."""
    time, _, _, speed, _ = drive(40.0)
    rng, way = np.random.default_rng(0), np.cumsum(speed) * 0.05
    table = np.c_[time, way + 0.1 * rng.normal(size=len(time)), 0 * way, speed][::4]
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header="t,x,y,speed", comments="")
    assert main(["fuse", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out"), "--steps", "1"]) == 0
    assert "pose0_pose (position) | x, y |" in capsys.readouterr().out
    path = np.genfromtxt(tmp_path / "out/path.csv", delimiter=",", names=True)
    assert np.abs(path["x"] - np.interp(path["time"], time, way)).mean() < 0.5
    assert np.abs(path["y"]).max() < 0.5


def test_the_command(tmp_path, capsys):
    time, place = write_log(tmp_path / "log.csv", 40.0)
    words = ["fuse", str(tmp_path / "log.csv"), "--out", str(tmp_path / "out"), "--steps", "0", "--gaps", "1"]
    assert main([*words, "--gap-seconds", "5"]) == 0
    out = capsys.readouterr().out
    assert "pose0_pose (gps) | x, y |" in out
    assert "In 1 gaps of 5 s, 4 fixes that were hidden" in out or "5 fixes that were hidden" in out
    path = np.genfromtxt(tmp_path / "out/path.csv", delimiter=",", names=True)
    true = np.c_[*(np.interp(path["time"] - 1.7e9, time, column) for column in place.T)]
    off = np.c_[path["x"], path["y"]] - true
    off -= off.mean(0)  # the frame begins at the first fix
    assert np.sqrt(np.square(off).sum(1).mean()) < 0.6
    assert np.loadtxt(tmp_path / "out/path.tum").shape == (len(path), 8)
    line = json.loads((tmp_path / "out/path.geojson").read_text())["geometry"]["coordinates"]
    np.testing.assert_allclose(line[0], ORIGIN[::-1], atol=1e-4)
    again = robot_model(tmp_path / "out/ekf.yaml")
    assert again.config.two_d
    assert len(again.config.sensors[0].variances) == 15
    assert (tmp_path / "out/path.png").stat().st_size > 10_000


def test_a_bag_against_its_own_filter():
    """/odom of a turtlebot, whose own filter publishes /ekf_state."""
    bag = SHARED / "logs" / "turtlebot.mcap"
    pytest.importorskip("rosbags")
    if not bag.exists():
        pytest.skip("the bag is not here")
    settings = {"two_d_mode": True, "frequency": 20.0, "odom0": "/odom", "odom0_config": flags(0, 1, 5, 6, 11)}
    settings |= {"initial_estimate_covariance": [1.0] * 15}
    model = robot_model(settings)
    streams = log_streams(bag)
    log = read_log(bag, model.config, streams)
    model = start_of(log, model)
    with torch.no_grad():
        out = model.filter.sequence(rows_of_log(log, model))
    theirs = streams["/ekf_state"].readings
    places = [theirs.columns.index(f"pose.pose.position.{axis}") for axis in "xy"]
    stamps = out["stamp"][:, 0].numpy()
    their = np.c_[*(np.interp(stamps, theirs.times, theirs.values[:, place]) for place in places)]
    off = np.linalg.norm(out["belief", "mean"][:, :2].numpy() - their, axis=1)
    assert np.sqrt(np.square(off).mean()) < 0.06
