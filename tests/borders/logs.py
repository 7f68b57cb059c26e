"""Logs whose files are valid and whose values are not: times of another clock, fixes that repeat, numbers too large.

What is wrong with them is a warning or an error, which names the file or sensor; warnings are raised here.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import torch
from hypothesis import strategies as st

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import INF, NAN, put
from benchmarks.reliability.documents import edited
from benchmarks.reliability.target import Source, Subject, Target, targets_of
from tests.borders.folders import ALL_ROWS, made
from tests.data.lerobot.lerobot_folder import pictures, write_version_2, write_version_3, write_video
from tests.data.recordings.own_files import SIZE, write_csv, write_images
from torch_denkf.data import Images, LeRobotReplay, Recording, RecordingReplay, Table
from torch_denkf.fusion import message_rows

ROWS = 400
CLOCK = 100.0 + np.arange(ROWS) / 50
WAVE = np.sin(np.arange(ROWS))


def told(act: Callable[..., Any]) -> Callable[..., Any]:
    """Runs with the library's warnings as errors."""

    def do(*args: Any, **given: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            return act(*args, **given)

    return do


def target(name: str, words: tuple[str, ...], act: Callable[..., Any], wrong: d.Wrong, right: Any = None) -> Target:
    """Returns values that a log is made of."""
    return Target("logs", name, words, told(act), wrong, right)


def replayed(folder: Path, streams: dict[str, dict[str, Any]], **columns: np.ndarray) -> Any:
    """Returns rows of a table, of which streams take columns."""
    file = write_csv(folder / "run.csv", **columns)
    tables = {name: Table(file, **options) for name, options in streams.items()}
    return RecordingReplay(Recording(**tables), split="all", cache=None)[:]


# ------------------------------------------------------------------------------------------------- times and numbers


def moved(place: int | slice, by: float) -> d.Change:
    """Adds to some times."""

    def act(times: np.ndarray) -> np.ndarray:
        return d.spoiled(place, times[place] + by)(times)

    return act


def bursts(of: int) -> d.Change:
    """Returns times at which packets of so many readings come."""
    number = np.arange(ROWS)
    return lambda times: times[number // of * of] - 2e-4 * (of - 1 - number % of)


#: Times that no sensor writes. A table raises for those that go back; messages warn of all.
TIMES = d.Wrong(
    {
        **{f"times {factor:g}": partial(np.multiply, factor) for factor in (1e3, 1e6, 1e9, 1 / 604800, 1e300)},
        "in ns since 1970": lambda times: 1e9 * (times + 1.7e9),
        "in ms since 1970": lambda times: 1e3 * (times + 1.7e9),
        "since 1970 but for the first": lambda times: np.append(0.0, times[1:] + 1.7e9),
        "an hour's gap": moved(slice(200, None), 3600),
        "two runs a day apart": moved(slice(200, None), 86400),
        "one an hour ahead, at the end": moved(-1, 3600),
        "one an hour back": moved(200, -3600),
        "one an hour ahead": moved(200, 3600),
        "with nan": moved(7, NAN),
        "with inf": moved(7, INF),
        "two runs": lambda times: np.tile(times[:200], 2),
        "bursts of 20": bursts(20),
        "bursts of 3": bursts(3),
    },
    st.floats(1e3, 1e12).map(lambda factor: (f"times {factor}", partial(np.multiply, factor)))
    | st.tuples(st.integers(2, ROWS - 2), st.floats(200.0, 1e9)).map(
        lambda one: (f"a gap of {one}", moved(slice(one[0], None), one[1]))
    ),
).each(lambda change: change(CLOCK))
#: One picture in eight is taken, of which a burst may be one step.
NO_STEPS = ("bursts of 20", "bursts of 3", "two runs", "with nan", "with inf")
NO_STEPS += ("one an hour back", "one an hour ahead", "one an hour ahead, at the end")
#: Numbers whose steps float32 does not resolve, an origin and a step: metres of a map, degrees, ticks, seconds.
LARGE = d.of(
    *((5.4e6, 0.02), (-5.4e6, 0.02), (51.04, 5e-6), (2.1e9, 7.0), (9e15, 7.0), (1.7e9, 0.02), (1.0, 1e-7)),
    others=st.tuples(st.floats(1e2, 1e30), st.floats(1e-9, 1e-7)).map(lambda one: (one[0], one[0] * one[1])),
)


def _stamps(times: np.ndarray, folder: Path) -> Any:
    return message_rows([(time, "gps", [np.sin(row)]) for row, time in enumerate(times)])


def _pictures(times: np.ndarray, folder: Path) -> Any:
    write_images(folder / "run", [f"{row:04d}.png" for row in range(ROWS // 8)])
    run = Recording(camera=Images(folder / "run", times=times[:: ROWS // len(times) * 8]))
    return RecordingReplay(run, size=SIZE, **ALL_ROWS)[:]


def _numbers(value: tuple[float, float]) -> np.ndarray:
    return value[0] + value[1] * np.random.default_rng(0).normal(size=(ROWS, 1)).cumsum(0)


def _large_messages(value: tuple[float, float], folder: Path) -> Any:
    return message_rows(list(zip(CLOCK, ["gps"] * ROWS, _numbers(value), strict=True)))


def _of_numbers() -> Iterator[Target]:
    table = lambda times, folder: replayed(folder, {"state": {}}, time=times, x=WAVE)  # noqa: E731
    large = lambda value, folder: replayed(folder, {"state": {}}, time=CLOCK, x=_numbers(value)[:, 0])  # noqa: E731
    # Stamps since 1970 say their unit by their size.
    yield target("times of a table", ("time", "run.csv"), table, TIMES.without("in ns since 1970", "in ms since 1970"))
    yield target("stamps of messages", ("gps",), _stamps, TIMES)
    yield target("times of pictures", ("time", "times", "run"), _pictures, TIMES.but(*NO_STEPS))
    yield target("large numbers of a table", ("run.csv",), large, LARGE)
    yield target("large numbers of messages", ("gps[0]",), _large_messages, LARGE)


# ----------------------------------------------------------------------------------------------------------- repeats

HELD = d.of(50, 2, 5, others=st.integers(2, 50))  # rows for which a fix stays
TWO = {"imu": {"columns": ["x"]}, "gps": {"columns": ["fix"]}}


def _held(streams: dict[str, dict[str, Any]]) -> Callable[[int, Path], Any]:
    def act(rows: int, folder: Path) -> Any:
        fix = np.random.default_rng(0).normal(size=ROWS // rows + 1).cumsum().repeat(rows)[:ROWS]
        return replayed(folder, streams, time=CLOCK, x=WAVE, fix=fix)

    return act


def _dropped(result: Any) -> bool:
    """Tells whether a fix counts once, in the row in which it comes."""
    fix = result["gps"].flatten()
    new = torch.cat([torch.ones(1, dtype=torch.bool), fix.diff() != 0])
    return len(result) == ROWS and bool((result["gps_observed"].flatten() == new).all())


# ---------------------------------------------------------------------------------------------------------- messages


def _imu(first: float, last: float, value: float = 1.0) -> list[tuple]:
    return [(time, "imu", [value]) for time in np.arange(first, last, 0.01)]


GPS = [(float(second), "gps", [0.1 * second]) for second in range(20)]
#: Messages of an IMU that is to drive a filter of these fixes.
DRIVING = d.Wrong(
    {
        "an hour later": _imu(3600, 3620),
        "an hour earlier": _imu(-3600, -3580),
        "ended at 5 s": _imu(0, 5),
        "silent for 10 s": _imu(0, 5) + _imu(15, 20),
        "begun at 12 s": _imu(12, 20),
        "of nan": _imu(0, 20, NAN),
        "of two sizes": [*_imu(0, 20), (20.5, "imu", [1.0, 2.0])],
    },
    st.tuples(st.floats(0.5, 18.0), st.floats(0.5, 10.0)).map(
        lambda one: (f"silent at {one}", _imu(0, one[0]) + _imu(min(19.5, sum(one)), 20.5))
    ),
)
MASKED = np.ma.masked_equal([1.0], 1.0)
MESSAGES = {
    "a message's stamp": d.of(None, "now", [1.0], NAN, MASKED[0]).each(lambda stamp: (stamp, "gps", [1.0])),
    "a message's value": d.of(None, "north", [[1.0]], [1.0, 2.0], MASKED).each(lambda value: (1.0, "gps", value)),
    "a message's noise": d.of("wide", [NAN], MASKED).each(lambda noise: (1.0, "gps", [1.0], noise)),
    "a message": d.of(3.0, "gps", None, {"stamp": 1.0}),
}
OPTIONS = {
    "driving": d.of(["imu"]),
    "delays": d.of({"imu": 1.0}, {"gps": NAN}, {"gps": INF}, {"gps": "late"}),
    "start": d.FINITE | {"behind the last": 30.0, "in ns": 1.7e18},
    "unit": d.of("h", 3, None),
    "origin": d.of({"imu": 1.0}, {"gps": NAN}, {"gps": [1.0, 2.0]}, {"gps": "x"}),
    "dtype": d.of(torch.int64, torch.bool, np.float32, "float32"),
}


def _of_messages() -> Iterator[Target]:
    yield target("a fix that is repeated", ("repeats",), _held(TWO), HELD)
    yield target("a slow column", ("repeats",), _held({"imu": {}}), HELD)
    dropping = {**TWO, "gps": {"columns": ["fix"], "repeats": "drop"}}
    yield target("a fix that is dropped", ("repeats",), _held(dropping), HELD, _dropped)
    drive = lambda imu, folder: message_rows(GPS + imu, driving=["imu"])  # noqa: E731
    yield target("an IMU", ("imu", "gps"), drive, DRIVING)
    for name, wrong in MESSAGES.items():
        one = lambda message, folder: message_rows([*GPS, message])  # noqa: E731
        yield target(name, ("gps", "Message"), one, wrong)
    log, also = told(lambda **given: message_rows(GPS, **given)), dict.fromkeys(OPTIONS, ("delay",))
    yield from targets_of("logs", Subject(log, wrong=OPTIONS, also=also, name="message_rows"))


# ------------------------------------------------------------------------------------------------- whole recordings


@told
def read(root: Path, **options: Any) -> Any:
    """Returns all rows, as a user reads them; warnings are errors."""
    return LeRobotReplay(root, **{"size": (12, 16), **ALL_ROWS, **options})[:]


ROBOT = Source("logs", made("robot", partial(write_version_2, lengths=[40, 9, 7, 8])), read, "robot: ")
NEWER = Source("logs", made("newer", partial(write_version_3, groups=[[40, 9], [7, 8]])), read)


def _large_joints(value: tuple[float, float]) -> d.Change:
    def act(file: Path) -> None:
        table = parquet.read_table(file)
        large = pa.array(list(_numbers(value)[: 3 * len(table)].reshape(-1, 3)), pa.list_(pa.float64()))
        at = table.column_names.index("observation.state")
        parquet.write_table(table.set_column(at, "observation.state", large), file)

    return act


def _renamed(name: str) -> d.Change:
    return edited(put("features", lambda old: {name if key == "action" else key: value for key, value in old.items()}))


def _lost(pattern: str) -> d.Change:
    return lambda root: [file.unlink() for file in sorted(root.glob(pattern))[1:]]


VIDEO = "videos/chunk-000/observation.images.top/episode_000001.mkv"
INFO, EPISODES = "meta/info.json", "meta/episodes.jsonl"
DATA = "data/chunk-000/episode_000000.parquet"


def _half_the_fps(root: Path) -> None:
    edited(put(("timestamp", 7), NAN))(root / DATA)
    edited(put("fps", 5))(root / INFO)


LOST = {"videos": _lost("videos/**/*.mkv"), "tables": _lost("data/**/*.parquet")}
#: A changed file, and the word that tells of it.
CONTRADICTIONS: dict[str, tuple[str, d.Change, str]] = {
    "an episode of no length": (EPISODES, edited(put((1, "length"), 0)), "metadata"),
    "an episode of another length": (EPISODES, edited(put((1, "length"), 5)), "metadata"),
    "twice the fps": (INFO, edited(put("fps", 20)), "fps"),
    "half the fps": (INFO, edited(put("fps", 5)), "fps"),
    "1.3 times the fps": (INFO, edited(put("fps", 13)), "fps"),
    "more episodes in all": (INFO, edited(put("total_episodes", 50)), "total_episodes"),
    "more frames in all": (INFO, edited(put("total_frames", 5000)), "total_frames"),
    "totals of text": (INFO, edited(put("total_episodes", "many")), "total_episodes"),
    "actions": (INFO, _renamed("actions"), "actions"),
    "commands": (INFO, _renamed("observation.command"), "observation.command"),
    "a video of another size": (
        VIDEO,
        lambda file: write_video(file, pictures(1, 9, (24, 32)), "FFV1"),
        Path(VIDEO).name,
    ),
    "half the fps, and a stamp of nan": ("", _half_the_fps, "fps"),
    "videos that are missing": ("", LOST["videos"], "episodes"),
    "tables that are missing": ("", LOST["tables"], "episodes"),
}
CHOICES = {
    "episodes": d.of([9], [], 3, "0", [0.5], [[0]], others=st.integers(4, 99).map(lambda one: [one])),
    "origin": d.of(3.0, {"joints": 1.0}, {"state": NAN}, {"state": [1.0, 2.0]}),
}


def _whole(result: Any) -> bool:
    """Tells whether the episodes that are there are read: the first one."""
    return len(result) == 40 and bool(result["observed"].all())


def _of_recordings() -> Iterator[Target]:
    for what, (file, change, word) in CONTRADICTIONS.items():
        yield ROBOT.target(what, change, None, word, file)
    yield ROBOT.target("a tenth more fps", edited(put("fps", 11)), ROBOT.like(near=1e-6), "fps", INFO)
    none, newer = edited(put(("length", 1), 0)), "meta/episodes/chunk-000/file-000.parquet"
    yield NEWER.target("an episode of no length", none, None, "metadata", newer)
    yield ROBOT.target("episodes that are whole", LOST, _whole, "episodes", options={"episodes": [0]})
    large = LARGE.but("(1.0, 1e-07)").each(_large_joints)
    yield ROBOT.target("large numbers of joints", large, None, "origin", DATA)
    for source, name in ((ROBOT, "version 2"), (NEWER, "version 3")):
        replay = source.arguments(f"LeRobotReplay of {name}", wrong=CHOICES)
        yield from targets_of("logs", replay, needs=source.sound)


def targets() -> Iterator[Target]:
    """Yields times, numbers, repeats, what drives, single messages, and recordings that contradict themselves."""
    for kind in (_of_numbers, _of_messages, _of_recordings):
        yield from kind()
