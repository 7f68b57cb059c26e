"""Delays between the streams of a log: known ones of simulated drives, and those of a car's log."""

import numpy as np
import pytest

from torch_denkf.cli.main import main
from torch_denkf.data import Recording, Table, clock_offsets
from torch_denkf.data.recordings.offsets import delays_between, solved
from torch_denkf.data.recordings.tables import Readings

LATE = {"wheels": 0.1, "gps": 0.3}


def drive(seed, seconds=120.0, noise=0.05):
    """Returns a gyro at 100 Hz, wheels at 20 Hz and 0.1 s late, GPS at 5 Hz and 0.3 s late; none in common units."""
    rng, dt, count = np.random.default_rng(seed), 0.01, round(100 * seconds)
    turn, speed = np.zeros(count), np.full(count, 2.0)
    for k in range(1, count):
        turn[k] = (1 - 0.3 * dt) * turn[k - 1] + 0.5 * dt**0.5 * rng.normal()
        speed[k] = 2 + (1 - 0.2 * dt) * (speed[k - 1] - 2) + 0.5 * dt**0.5 * rng.normal()
    speed = speed.clip(0)
    summed = lambda rate: np.append(0, np.cumsum(rate[1:] + rate[:-1]) * dt / 2)  # noqa: E731
    heading = summed(turn)
    place = np.c_[summed(speed * np.cos(heading)), summed(speed * np.sin(heading))]
    time, wheels, gps = np.arange(count) * dt, slice(3, None, 5), slice(7, None, 20)
    fixes, speeds = place[gps], speed[wheels]
    return {
        "gyro": Readings(time, np.degrees(turn + 0.02 + 0.02 * rng.normal(size=count))[:, None], ("yaw_rate",)),
        "wheels": Readings(
            time[wheels] + LATE["wheels"], 3.6 * (speeds + 0.05 * rng.normal(size=len(speeds)))[:, None], ("speed",)
        ),
        "gps": Readings(time[gps] + LATE["gps"], fixes + noise * rng.normal(size=fixes.shape), ("x", "y")),
    }


def test_delays_that_are_known():
    """Errors are below .05 s, and the coverage of the 95 % intervals is at least 34 of 40 (38 expected)."""
    held = 0
    for seed in range(20):
        tables = drive(seed)
        found = solved(delays_between(tables, most=2.0), tables)
        assert found["gyro"] == (0.0, 0.0)
        for name, late in LATE.items():
            error = found[name].seconds + late
            assert abs(error) < 0.05
            held += abs(error) < 1.96 * found[name].std
            assert found[name].std < 0.05
    assert held >= 34


def test_units_from_scales():
    tables = drive(0)
    scales = {(delay.late, delay.early): delay.scale for delay in delays_between(tables, most=2.0)}
    assert scales["gps", "wheels"] == pytest.approx(1 / 3.6, rel=0.05)
    assert scales["gps", "gyro"] == pytest.approx(np.pi / 180, rel=0.1)


def test_streams_that_share_nothing(tmp_path):
    """A robot that drives a circle says nothing of delays, though its turn rates agree."""
    time = np.arange(0, 30, 0.05)
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        rate = 0.5 + 1e-4 * rng.normal(size=len(time))
        np.savetxt(tmp_path / f"{name}.txt", np.c_[time, rate], header="time yaw_rate")
    run = Recording(name="run", **{name: Table(tmp_path / f"{name}.txt") for name in ("a", "b")})
    with pytest.raises(ValueError, match=r"recording 'run': no two of \['a', 'b'\] know the same turns"):
        clock_offsets(run)


def test_oddities_of_a_log(tmp_path, capsys):
    time = np.arange(0, 40, 0.1)
    time = time[(time < 10) | (time > 14)]
    rng = np.random.default_rng(0)
    values = np.c_[time, rng.normal(size=(len(time), 2)) * 0.1, 1 + 0.01 * rng.normal(size=len(time))]
    np.savetxt(tmp_path / "log.txt", values, header="time acc_x acc_y acc_z")
    assert main(["log", str(tmp_path / "log.txt")]) == 0
    out = capsys.readouterr().out
    assert "imu: 359 readings, 10 Hz" in out
    assert "1 gaps, the longest 4.2 s at 9.9 s" in out
    assert "accelerations of 1.01 look like another unit than m/s^2" in out
    assert "no two streams know the same" in out
