"""Rows of one's own recordings are the numbers in their files, on the clock that was asked for."""

from contextlib import nullcontext
from functools import partial

import numpy as np
import pytest

from tests.data import replay_for_tests as shared
from tests.data.recordings.own_files import SIZE, pixels, write_csv, write_images, write_video
from torch_denkf.data import Images, Recording, RecordingReplay, Table, Video
from torch_denkf.data.episodes import hashed_share

open_runs = partial(RecordingReplay, size=SIZE, cache=None, progress=False)


def truth(time):
    return np.stack([np.sin(time), 2 * time], -1)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Returns a video at 10 Hz from 0 s on; x and y at 100 Hz from 0.155 s on; a command every 0.25 s."""
    folder = tmp_path_factory.mktemp("run")
    write_video(folder / "run1.mkv", 20)
    time = 0.155 + np.arange(160) / 100
    write_csv(folder / "run1.csv", t=time, x=truth(time)[:, 0], y=truth(time)[:, 1], gyro=time**2)
    write_csv(folder / "commands.csv", time=np.arange(12) / 4, speed=np.arange(12))
    return folder


def streams(folder, **options):
    return {
        "camera": Video(folder / "run1.mkv"),
        "state": Table(folder / "run1.csv", ["x", "y"], time="t", **options),
        "gyro": Table(folder / "run1.csv", columns=["gyro"], time="t"),
        "action": Table(folder / "commands.csv"),
    }


def test_a_video_at_10_hz_and_a_table_at_100_hz(run):
    data = open_runs(Recording(**streams(run)))
    shared.check_contract(data)
    shared.check_indices(data)
    rows = data[:]
    # From frame 2, at 0.2 s, the first after the table's begin at 0.155 s; to 1.7 s, before its end at 1.745 s.
    time = np.arange(2, 18) / 10
    np.testing.assert_allclose(rows["time"].flatten(), time - 0.2, atol=1e-9)
    assert data.episodes[0].begin == pytest.approx(0.2)
    assert (data.episodes[0].name, data.episodes[0].length) == ("run1", 16)
    for row, number in enumerate(range(2, 18)):
        assert (rows["pixels"][row].numpy() == pixels(number)).all()
    assert rows["observed"].all()
    # The last reading before 0.2 s is that of 0.195 s, and so on: never a later one.
    np.testing.assert_allclose(rows["state"], truth(time - 0.005), atol=1e-6)
    np.testing.assert_allclose(rows["gyro"].flatten(), (time - 0.005) ** 2, rtol=1e-6)
    assert rows["state_observed"].all()
    # Commands come at 0, 0.25, 0.5 s: that of 0 s holds at 0.2 s; it is new in the first row alone.
    speeds = np.floor(time / 0.25 + 1e-9)
    assert rows["action"].flatten().tolist() == speeds.tolist()
    assert rows["action_observed"].flatten().tolist() == [True, *(np.diff(speeds) > 0)]
    assert data.columns == {"state": ("x", "y"), "gyro": ("gyro",), "action": ("speed",)}


def test_linear_interpolation_and_the_nearest(run):
    time = np.arange(2, 18) / 10
    linear = open_runs(Recording(**streams(run, sample="linear")))[:]
    # Halfway between two readings 0.01 s apart; a sine bends by less than 0.01 ** 2 / 8 there.
    np.testing.assert_allclose(linear["state"], truth(time), atol=1.3e-5)
    near = open_runs(Recording(camera=Video(run / "run1.mkv"), late=Table(run / "commands.csv", sample="nearest")))[:]
    # Frames at 0, 0.1, ... 1.9 s; commands each 0.25 s count within half a frame's time, so 0.25 s is nearest to 0.2
    # and 0.3 s alike, and seen in the first of them.
    seen = near["late_observed"].flatten().nonzero().flatten().tolist()
    assert seen == [0, 2, 5, 7, 10, 12, 15, 17]
    assert near["late"].flatten()[seen].tolist() == list(range(8))
    assert not near["late"].flatten()[[1, 4, 6, 9]].any()


def test_a_rate_shows_each_picture_once(run):
    rows = open_runs(Recording(**streams(run)), clock=25.0)[:]
    time = 0.155 + np.arange(len(rows)) / 25
    assert len(rows) == 1 + int((1.745 - 0.155) * 25)
    np.testing.assert_allclose(rows["state"], truth(time), atol=1e-6)  # these fall on the table's times
    frame = np.floor(time * 10 + 1e-6)
    new = np.diff(frame, prepend=-1) > 0
    assert rows["observed"].flatten().tolist() == new.tolist()
    for row in range(len(rows)):
        assert (rows["pixels"][row].numpy() == (pixels(int(frame[row])) if new[row] else 0)).all()


def test_old_readings_are_missing_beyond_the_tolerance(run):
    table = Table(run / "commands.csv", tolerance=0.12)
    rows = open_runs(Recording(camera=Video(run / "run1.mkv"), speed=table))[:]
    age = np.arange(20) / 10 % 0.25
    held = age <= 0.12 + 1e-6
    expected = np.where(held, np.floor(np.arange(20) / 2.5 + 1e-9), 0)
    assert rows["speed"].flatten().tolist() == expected.tolist()


def test_images_are_in_the_order_of_their_numbers(tmp_path):
    names = ["9.5", "9.75", "10", "10.125"]
    write_images(tmp_path / "run", [f"{name}.png" for name in names])
    data = open_runs(Recording(eye=Images(tmp_path / "run")))
    assert data[:]["time"].flatten().tolist() == [0, 0.25, 0.5, 0.625]
    assert (data[:]["pixels"].numpy() == np.stack([pixels(k) for k in range(4)])).all()


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (["img_0", "img_1", "img_3", "img_4"], [0, 1, 3, 4]),  # number 2 is missing
        (["000005", "000010", "000025", "000030"], [0, 1, 4, 5]),  # each fifth was kept; 15 and 20 are missing
        (["9_left", "10_left", "12_left", "13_left"], [0, 1, 3, 4]),
        (["0", "33", "67", "100"], [0, 1, 2, 3]),  # stamps, not counts
        (["run1_8", "run1_9", "run2_0", "run2_5"], [0, 1, 2, 3]),
        (["1_3", "2_0", "13_1", "14_1"], [0, 1, 2, 3]),  # 1_3 is not 13
    ],
)
def test_a_missing_image_moves_no_other_one(tmp_path, names, times):
    write_images(tmp_path / "run", [f"{name}.png" for name in names])
    missing = times[-1] + 1 - len(times)
    warned = pytest.warns(
        UserWarning, match=f"by their numbers {missing} images are missing, the first after {names[1]}"
    )
    with warned if missing else nullcontext():
        data = open_runs(Recording(eye=Images(tmp_path / "run", rate=10.0, start=2.0)))
    np.testing.assert_allclose(data[:]["time"].flatten(), np.array(times) / 10, atol=1e-12)
    assert (data[:]["pixels"].numpy() == np.stack([pixels(k) for k in range(4)])).all()


# Several recordings ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    recordings = []
    for k, length in enumerate((9, 14, 11, 12)):
        write_images(folder / f"run{k}", [f"{n:03d}.png" for n in range(length)])
        write_csv(folder / f"run{k}.csv", time=np.arange(length) / 10, x=k + np.arange(length) / 100, y=np.ones(length))
        camera = Images(folder / f"run{k}", rate=10.0)
        recordings.append(Recording(camera=camera, state=Table(folder / f"run{k}.csv")))
    return recordings


def test_recordings_are_episodes(runs, tmp_path):
    data = open_runs(runs, batch_size=24, slice_len=6)
    shared.check_contract(data)
    assert [(e.name, e.length) for e in data.episodes] == [("run0", 9), ("run1", 14), ("run2", 11), ("run3", 12)]
    shared.check_slices(data, {}, "step", ("pixels", "state", "observed"))
    shared.check_preprocess(open_runs(runs), tmp_path)
    share = sum(sorted(hashed_share(e.name, "test") for e in data.episodes)[1:3]) / 2  # two of the four
    test = open_runs(runs, test_share=share, split="test")
    train = open_runs(runs, test_share=share)
    assert len(test.episodes) == len(train.episodes) == 2
    assert {e.name for e in test.episodes} | {e.name for e in train.episodes} == {e.name for e in data.episodes}
    which = [int(e.name[3:]) for e in train.episodes]
    lengths = {e.name: e.length for e in data.episodes}
    steps = [(k, np.arange(lengths[f"run{k}"])) for k in which]
    shared.check_statistics(
        test.statistics,
        state=np.concatenate([np.stack([k + step / 100, np.ones(len(step))], -1) for k, step in steps]),
        pixels=np.concatenate([np.stack([pixels(n)[:, 0, 0] for n in step]) for _, step in steps]),
    )


# Filters --------------------------------------------------------------------------------------------------------------
