"""Streams that begin later than others, and readings that arrive later than they were taken."""

import warnings
from functools import partial

import numpy as np
import pytest
import torch

from tests.data.recordings.own_files import SIZE, write_csv, write_images
from torch_denkf.data import Images, Recording, RecordingReplay, Table

open_runs = partial(RecordingReplay, cache=None, size=SIZE, progress=False)


@pytest.fixture
def walk(tmp_path):
    """1.4 m/s from x = 5 m at 0 s on: an odometer at 10 Hz from 0 to 4 s, and a GPS from 1 to 3 s."""
    wheel = np.arange(41) / 10
    gps = 1 + np.arange(21) / 10
    write_csv(tmp_path / "wheel.csv", time=wheel, speed=np.full(41, 1.4))
    write_csv(tmp_path / "gps.csv", time=gps, x=5 + 1.4 * gps)
    return {"wheel": Table(tmp_path / "wheel.csv"), "gps": Table(tmp_path / "gps.csv")}


@pytest.mark.parametrize("clock", ["wheel", 10.0])
def test_rows_before_the_last_stream_begins_are_kept_where_they_are_asked_for(walk, clock):
    with pytest.warns(
        UserWarning, match=r"'run': 1 s before its first row and 1 s after its last .* 'gps' begins at 1 s"
    ):
        common = open_runs(Recording(name="run", **walk), clock=clock)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = open_runs(Recording(name="run", **walk), clock=clock, span="all")
    assert (common.episodes[0].begin, common.episodes[0].length) == (1.0, 21)
    assert (data.episodes[0].begin, data.episodes[0].length) == (0.0, 41)
    rows = data[:]
    np.testing.assert_allclose(rows["time"].flatten(), np.arange(41) / 10, atol=1e-9)
    seen = rows["gps_observed"].flatten()
    assert seen.tolist() == [10 <= k <= 30 for k in range(41)]
    for key in ("gps", "gps_observed", "wheel"):
        assert rows[key][10:31].equal(common[:][key])
    assert not rows["gps"][:10].any()
    assert rows["gps"][31:].eq(rows["gps"][30]).all()  # the last one is held
    # Dead reckoning from the pose at 0 s meets each fix; from the same pose at the first common row it is 1.4 m off.
    for first, of, error in ((0, rows, 0.0), (0, common[:], 1.4)):
        way = 5 + 0.1 * of["wheel"][first:-1].cumsum(0)
        off = (of["gps"][1:] - way)[of["gps_observed"][1:]]
        torch.testing.assert_close(off, torch.full_like(off, error), rtol=0, atol=1e-5)


def test_pictures_and_interpolation_before_and_after_their_time(tmp_path):
    write_images(tmp_path / "run", [f"{k}.png" for k in range(6)])
    write_csv(tmp_path / "state.csv", time=[1.5, 3.5], x=[10, 30])
    state = Table(tmp_path / "state.csv", sample="linear")
    rows = open_runs(Recording(camera=Images(tmp_path / "run"), state=state), span="all")[:]
    assert rows["observed"].all()
    assert rows["state"].flatten().tolist() == [0, 0, 15, 25, 0, 0]
    assert rows["state_observed"].flatten().tolist() == [False, False, True, True, False, False]
    rows = open_runs(Recording(camera=Images(tmp_path / "run", start=2.0), state=state), clock="state", span="all")[:]
    assert rows["observed"].flatten().tolist() == [False, True]
    with pytest.raises(ValueError, match="fewer than two rows in common"):  # other clocks, or a wrong unit
        open_runs(Recording(camera=Images(tmp_path / "run", start=9.0), state=state), span="all")
    with pytest.raises(ValueError, match="span is 'common' or 'all', got 'both'"):
        open_runs(Recording(state=state), span="both")


# Readings that come late ----------------------------------------------------------------------------------------------


def late_files(folder, seed=0):
    """Returns an encoder at 10 Hz, and a GPS with a latency of 0.05 to 0.9 s, so that fixes arrive out of order."""
    generator = np.random.default_rng(seed)
    taken = np.sort(generator.uniform(0, 6, 12))
    arrived = taken + generator.uniform(0.05, 0.9, 12)
    assert (np.diff(arrived) < 0).any()
    write_csv(folder / "encoder.csv", time=np.arange(80) / 10, angle=generator.normal(size=80))
    write_csv(folder / "gps.csv", taken=taken, arrived=arrived, x=generator.normal(size=12), y=np.arange(12))
    gps = Table(folder / "gps.csv", time="taken", arrived="arrived")
    return Recording(name="run", encoder=Table(folder / "encoder.csv"), gps=gps), taken, arrived


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("span", ["common", "all"])
def test_reading_is_in_the_row_after_its_arrival(tmp_path, seed, span):
    recording, taken, arrived = late_files(tmp_path, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data = open_runs(recording, span=span)
    rows, values = data[:], recording.streams["gps"].read().values
    assert data.columns["gps"] == ("x", "y")
    times = rows["time"].flatten().numpy() + data.episodes[0].begin
    held, before, shown = None, -np.inf, 0
    for row, time in enumerate(times):
        new = [k for k in np.argsort(arrived) if before < arrived[k] <= time]
        held, before = new[-1] if new else held, time
        assert rows["gps_observed"][row].item() == bool(new)
        if held is None:
            assert not rows["gps"][row].any()
            continue
        np.testing.assert_allclose(rows["gps"][row], values[held], atol=1e-6)
        belongs = np.ceil(round(10 * taken[held] - 10 * times[0], 9))  # the row at which it was taken, or the next
        assert rows["gps_late"][row].tolist() == [row - belongs]
        shown += bool(new)
    assert shown > 6
    assert rows["gps_late"].dtype == torch.int64
