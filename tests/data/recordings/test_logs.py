"""Logs as robots write them: large numbers, fixes that are repeated, times in another unit or from another clock.

Oracles: the numbers that were written, in float64; numpy's count of changes.
"""

import warnings

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from tests.data.recordings.own_files import SIZE, write_csv
from torch_denkf.data import Recording, RecordingReplay, Table


def replay(**streams):
    return RecordingReplay(Recording(name="run", **streams), split="all", size=SIZE, cache=None, progress=False)[:]


@pytest.fixture(autouse=True)
def _no_other_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        yield


@pytest.mark.parametrize(
    ("origin", "step", "resolved"),
    [
        (5.4e6, 0.02, "0.5"),  # UTM, m
        (51.04, 5e-6, "3.8e-06"),  # latitude, degrees
        (2.1e9, 7.0, "1.3e\\+02"),  # encoder ticks
        (1.7e9, 0.01, "1.2e\\+02|1.3e\\+02"),  # a second clock, s
        (-5.4e6, 0.02, "0.5"),
    ],
)
def test_large_numbers(tmp_path, origin, step, resolved):
    """They are warned of with their step and float32's; behind their origin they keep it."""
    moved = step * np.random.default_rng(0).permutation([1] * 120 + [2] * 80).cumsum()
    file = write_csv(tmp_path / "run.csv", time=np.arange(200) / 10, x=origin + moved, y=moved)
    match = rf"run.csv: 'x' moves by {step:.3g} a row near .* float32 resolves ({resolved});"
    with pytest.warns(UserWarning, match=match) as said:
        swallowed = replay(state=Table(file))["state"][:, 0]
    assert len(said) == 1
    assert said[0].filename == __file__
    assert "origin={'x': " in str(said[0].message)
    assert "'y'" not in str(said[0].message)
    assert (swallowed.double() - torch.from_numpy(origin + moved)).abs().max() > step / 50
    kept = replay(state=Table(file, origin={"x": origin}))["state"]
    assert_close(kept[:, 0].double(), torch.from_numpy(moved), rtol=1e-6, atol=2 * np.spacing(abs(origin)))
    assert_close(kept[:, 1].double(), torch.from_numpy(moved), rtol=1e-6, atol=0)


def test_numbers_that_float32_holds_are_not_warned_of(tmp_path):
    random, time = np.random.default_rng(0), np.arange(200) / 10
    columns = {
        "position": 100 * np.sin(time),
        "ticks": 1e6 + np.arange(200.0),
        "large_ticks": 2.0**31 + 1024 * np.arange(200.0),  # each is a float32
        "pressure": 101325 + random.normal(size=200),
        "still": np.full(200, 5.4e6 + 0.03),
        "outlier": np.where(np.arange(200) == 70, 1e12 / 3, random.normal(size=200)),
        "mostly_zero": np.where(np.arange(200) % 20 == 7, random.normal(size=200), 0.0),
    }
    file = write_csv(tmp_path / "run.csv", time=time, **columns)
    rows = replay(state=Table(file))["state"]
    assert_close(rows, torch.tensor(np.stack(list(columns.values()), 1), dtype=torch.float32))


def fixes(count=60, held=8, seed=0):
    """Returns a random walk at 10 Hz, read every ``held`` rows with unit noise, and repeated in between."""
    random = np.random.default_rng(seed)
    walk = random.normal(size=count * held).cumsum() * 0.3
    return walk, (walk[::held] + random.normal(size=count)).repeat(held), held


def test_a_fix_that_is_repeated_counts_once(tmp_path):
    walk, gps, held = fixes()
    file = write_csv(tmp_path / "run.csv", time=np.arange(len(walk)) / 10, x=walk, gps=gps)
    state = Table(file, ["x"])
    with pytest.warns(UserWarning, match=r"run.csv: 'gps' repeats its last reading in 88 % of the rows.*'drop'"):
        kept = replay(state=state, gps=Table(file, ["gps"]))
    assert kept["gps_observed"].all()
    rows = replay(state=state, gps=Table(file, ["gps"], repeats="drop"))
    new = torch.arange(len(rows)) % held == 0
    assert rows["gps_observed"].squeeze(-1).equal(new)
    assert rows["gps"].equal(kept["gps"])  # held, not observed
    assert (replay(state=state, gps=Table(file, ["gps"], repeats="keep")) == kept).all()


def test_values_that_are_no_repeats(tmp_path):
    """A robot that stands, an encoder's ticks, a temperature, commands that are held."""
    random, count = np.random.default_rng(0), 400
    speed = random.normal(size=count)
    speed[100:300] = 0.0
    columns = {"speed": speed, "ticks": np.arange(count) // 3, "temperature": 20 + 0.1 * (np.arange(count) // 40)}
    columns["mode"] = np.ones(count)
    held = random.normal(size=count // 10).repeat(10)
    file = write_csv(tmp_path / "run.csv", time=np.arange(count) / 10, **columns, command=held)
    assert len(replay(state=Table(file, list(columns)), action=Table(file, ["command"]))) == count


def test_arrivals_of_repeated_fixes(tmp_path):
    """The first row of each fix says when it was taken and when it came."""
    _, gps, held = fixes(20)
    time = np.arange(len(gps)) / 10
    file = write_csv(tmp_path / "run.csv", time=time, came=time + 0.25, gps=gps)
    read = Table(file, ["gps"], arrived="came", repeats="drop").read()
    assert_close(read.times, time[::held])
    assert_close(read.arrived, time[::held] + 0.25)


def queued(rate, count=2000):
    """Returns steps by 0.2 ms at 5 % of the stamps, and by 0.16 s at 2 %; the others make up for both."""
    steps = np.full(count, 1 / rate)
    order = np.random.default_rng(0).permutation(count)
    steps[order[: count // 20]], steps[order[-count // 50 :]] = 2e-4, 0.16
    return steps.cumsum()


def bursts(count=1000):
    """Returns a sensor of 100 Hz, of whose stamps some are those of a queue that is emptied at once."""
    time = np.arange(count) * 0.01
    for first in range(20, count - 20, 50):
        time[first : first + 18] = time[first + 18] - 0.0002 * np.arange(18, 0, -1)
    return time


@pytest.mark.parametrize(
    ("time", "seen"),
    [
        (np.arange(200) * 1e7, "has steps of usually 1e\\+07 s"),  # ns
        (np.arange(200) * 10.0, "has steps of usually 10 s"),  # ms
        (np.arange(200) * 1e-8, "has steps of usually 1e-08 s"),  # s, read as something longer
        (1.7e12 + np.arange(200.0), "has times up to 1.7e\\+12 s, later than any since 1970"),  # ms of 1 kHz
        (np.append(0.0, 1.7e9 + np.arange(200) / 10), "has nothing for 1.7e\\+09 s after 0 s"),
        (np.append(np.arange(200), 3600 * 24 + np.arange(200)) / 10, "has nothing for 8620 s after 19.9 s"),
        (bursts(), "comes in bursts: .* below"),
        (queued(100.0), "comes in bursts: .* below"),
        (queued(20.0), "comes in bursts: .* below"),
    ],
)
def test_times_that_no_log_has(tmp_path, time, seen):
    file = write_csv(tmp_path / "run.csv", time=time, x=np.arange(len(time)))
    with pytest.warns(UserWarning, match=rf"run.csv: 'time' {seen}.*pass unit='ms', 'us' or 'ns'"):
        Table(file, unit="s").read()


def test_times_that_logs_have(tmp_path):
    """Uneven ones, a tunnel without GPS, a camera that skips, a slow sensor, a random one, a log of two rows."""
    random = np.random.default_rng(0)
    logs = [
        1.7e9 + (np.arange(500) + 0.3 * random.random(500)) / 50,
        np.delete(np.arange(300.0), slice(100, 130)),
        np.delete(np.arange(300) / 30, random.integers(0, 300, 30)),
        np.arange(20) * 4.0,
        random.exponential(0.1, 500).cumsum(),
        np.array([0.0, 1e5]),
    ]
    for time in logs:
        Table(write_csv(tmp_path / "run.csv", time=time, x=np.arange(len(time)))).read()
