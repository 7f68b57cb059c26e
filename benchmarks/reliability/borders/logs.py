"""Logs whose files are sound and whose numbers are not: times of another clock, fixes that repeat, numbers too large.

What is wrong with them is a warning or an error, which names the file or sensor; warnings are raised here.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import torch
from hypothesis import strategies as st

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import apart, workshop
from benchmarks.reliability.documents import edited
from benchmarks.reliability.target import Target
from tests.data.lerobot.lerobot_folder import write_version_2, write_version_3
from tests.data.recordings.own_files import SIZE, write_csv, write_images
from torch_denkf.data import Images, LeRobotReplay, Recording, RecordingReplay, Table
from torch_denkf.fusion import message_rows

ROWS = 400
NAN, INF = float("nan"), float("inf")


def told(act: Callable[..., Any]) -> Callable[..., Any]:
    """Runs with the library's warnings as errors."""

    def do(*args: Any, **given: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("error", UserWarning)
            return act(*args, **given)

    return do


# ------------------------------------------------------------------------------------------------------------- times


def _clock() -> np.ndarray:
    return 100.0 + np.arange(ROWS) / 50


def _set(place: int | slice, change: Callable[[np.ndarray], Any]) -> Callable[[np.ndarray], np.ndarray]:
    def act(times: np.ndarray) -> np.ndarray:
        times = times.copy()
        times[place] = change(times[place])
        return times

    return act


def _bursts(times: np.ndarray, of: int = 20) -> np.ndarray:
    number = np.arange(len(times))
    return times[number // of * of] - 2e-4 * (of - 1 - number % of)


#: Times that no sensor writes. A table raises for those that go back; messages warn of all.
TIMES: d.Wrong = d.Wrong(
    {
        "in ms": lambda times: 1e3 * times,
        "in us": lambda times: 1e6 * times,
        "in ns": lambda times: 1e9 * times,
        "in ns since 1970": lambda times: 1e9 * (times + 1.7e9),
        "in ms since 1970": lambda times: 1e3 * (times + 1.7e9),
        "in weeks": lambda times: times / 604800,
        "since 1970 but for the first": lambda times: np.append(0.0, times[1:] + 1.7e9),
        "an hour's gap": _set(slice(200, None), lambda times: times + 3600),
        "one an hour ahead, at the end": _set(-1, lambda time: time + 3600),
        "one an hour back": _set(200, lambda time: time - 3600),
        "one an hour ahead": _set(200, lambda time: time + 3600),
        "two runs": lambda times: np.tile(times[:200], 2),
        "two runs a day apart": _set(slice(200, None), lambda times: times + 86400),
        "bursts of 20": _bursts,
        "bursts of 3": partial(_bursts, of=3),
        "of 1e300": lambda times: 1e300 * times,
        "with nan": _set(7, lambda time: NAN),
        "with inf": _set(7, lambda time: INF),
    },
    d.drawn(st.floats(1e3, 1e12)).map(lambda one: (f"{one[0]} as long", lambda times: one[1] * times))
    | d.drawn(st.tuples(st.integers(2, ROWS - 2), st.floats(200.0, 1e9))).map(
        lambda one: (f"a gap of {one[0]}", _set(slice(one[1][0], None), lambda times: times + one[1][1]))
    ),
)


def _table(times: np.ndarray, folder: Path) -> Any:
    file = write_csv(folder / "run.csv", time=times, x=np.sin(np.arange(ROWS)))
    return RecordingReplay(Recording(state=Table(file)), split="all", cache=None)[:]


def _messages(times: np.ndarray, folder: Path) -> Any:
    return message_rows([(time, "gps", [np.sin(row)]) for row, time in enumerate(times)])


def _pictures(times: np.ndarray, folder: Path) -> Any:
    write_images(folder / "run", [f"{row:04d}.png" for row in range(ROWS // 8)])
    run = Recording(camera=Images(folder / "run", times=times[:: ROWS // len(times) * 8]))
    return RecordingReplay(run, split="all", cache=None, size=SIZE, progress=False)[:]


def _times() -> Iterator[Target]:
    changed = TIMES.each(lambda change: change(_clock()))
    # Stamps since 1970 say their unit by their size.
    table = d.Wrong(TIMES.but("in ns since 1970", "in ms since 1970").named, TIMES.others)
    stamps = table.each(lambda change: change(_clock()))
    yield Target("logs", "times of a table", ("time", "run.csv"), told(_table), stamps)
    yield Target("logs", "stamps of messages", ("gps",), told(_messages), changed)
    # One picture in eight is taken, of which a burst may be one step.
    some = TIMES.but(
        "one an hour ahead, at the end",
        "bursts of 20",
        "bursts of 3",
        "two runs",
        "one an hour back",
        "one an hour ahead",
        "with nan",
        "with inf",
    )
    kept = d.Wrong({what: change(_clock()) for what, change in some.named.items()})
    yield Target("logs", "times of pictures", ("time", "times", "run"), told(_pictures), kept)


# ----------------------------------------------------------------------------------------------------------- numbers

#: Numbers whose steps float32 does not resolve: an origin and a step.
LARGE = d.Wrong(
    {
        "metres of a map": (5.4e6, 0.02),
        "metres below zero": (-5.4e6, 0.02),
        "degrees of latitude": (51.04, 5e-6),
        "ticks": (2.1e9, 7.0),
        "ticks of 64 bits": (9e15, 7.0),
        "seconds since 1970": (1.7e9, 0.02),
        "small numbers": (1.0, 1e-7),
    },
    d.drawn(st.tuples(st.floats(1e2, 1e30), st.floats(1e-9, 1e-7))).map(
        lambda one: (one[0], (one[1][0], one[1][0] * one[1][1]))
    ),
)


def _numbers(origin: float, step: float) -> np.ndarray:
    return origin + step * np.random.default_rng(0).normal(size=(ROWS, 1)).cumsum(0)


def _large_table(value: tuple[float, float], folder: Path) -> Any:
    file = write_csv(folder / "run.csv", time=_clock(), x=_numbers(*value)[:, 0])
    return RecordingReplay(Recording(state=Table(file)), split="all", cache=None)[:]


def _large_messages(value: tuple[float, float], folder: Path) -> Any:
    return message_rows(list(zip(_clock(), ["gps"] * ROWS, _numbers(*value), strict=True)))


def _large_joints(value: tuple[float, float], folder: Path) -> Any:
    root = _robot(folder)
    file = root / "data/chunk-000/episode_000000.parquet"
    table = parquet.read_table(file)
    large = pa.array(list(_numbers(*value)[: 3 * len(table)].reshape(-1, 3)), pa.list_(pa.float64()))
    at = table.column_names.index("observation.state")
    parquet.write_table(table.set_column(at, "observation.state", large), file)
    return _replay(root)


# ----------------------------------------------------------------------------------------------------------- repeats

HELD = d.Wrong(
    {"for 50 rows": 50, "for two rows": 2, "for five rows": 5},
    d.drawn(st.integers(2, 50)).map(lambda one: (f"for {one[0]} rows", one[1])),
)


def _held(rows: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=ROWS // rows + 1).cumsum().repeat(rows)[:ROWS]


def _repeated(rows: int, folder: Path, **options: Any) -> Any:
    file = write_csv(folder / "run.csv", time=_clock(), x=np.sin(np.arange(ROWS)), fix=_held(rows))
    streams = {"imu": Table(file, ["x"]), "gps": Table(file, ["fix"], **options)}
    return RecordingReplay(Recording(**streams), split="all", cache=None)[:]


def _mixed(rows: int, folder: Path) -> Any:
    file = write_csv(folder / "run.csv", time=_clock(), x=np.sin(np.arange(ROWS)), fix=_held(rows))
    return RecordingReplay(Recording(imu=Table(file)), split="all", cache=None)[:]


def _dropped(result: Any) -> bool:
    """Right where a fix counts once, in the row in which it comes."""
    fix = result["gps"].flatten()
    new = torch.cat([torch.ones(1, dtype=torch.bool), fix.diff() != 0])
    return len(result) == ROWS and bool((result["gps_observed"].flatten() == new).all())


# ----------------------------------------------------------------------------------------------------------- driving


def _imu(first: float, last: float) -> list[tuple]:
    return [(time, "imu", [1.0]) for time in np.arange(first, last, 0.01)]


GPS = [(float(second), "gps", [0.1 * second]) for second in range(20)]
DRIVING = d.Wrong(
    {
        "an hour later": _imu(3600, 3620),
        "an hour earlier": _imu(-3600, -3580),
        "ended at 5 s": _imu(0, 5),
        "silent for 10 s": _imu(0, 5) + _imu(15, 20),
        "begun at 12 s": _imu(12, 20),
        "of nan": [(time, "imu", [NAN]) for time, *_ in _imu(0, 20)],
        "of two sizes": [*_imu(0, 20), (20.5, "imu", [1.0, 2.0])],
    },
    d.drawn(st.tuples(st.floats(0.5, 18.0), st.floats(0.5, 10.0))).map(
        lambda one: (f"silent at {one[0]}", _imu(0, one[1][0]) + _imu(min(19.5, sum(one[1])), 20.5))
    ),
)


def _drive(imu: list[tuple], folder: Path) -> Any:
    return message_rows(GPS + imu, driving=["imu"])


def _log(**given: Any) -> Any:
    return message_rows(GPS, **given)


def _one(message: Any, folder: Path) -> Any:
    return message_rows([*GPS, message])


MASKED = np.ma.masked_equal([1.0], 1.0)
OPTIONS = {
    "driving": d.of(["imu"]),
    "delays": d.of({"imu": 1.0}, {"gps": NAN}, {"gps": INF}, {"gps": "late"}),
    "start": d.FINITE | {"behind the last": 30.0, "in ns": 1.7e18},
    "unit": d.of("h", 3, None),
    "origin": d.of({"imu": 1.0}, {"gps": NAN}, {"gps": [1.0, 2.0]}, {"gps": "x"}),
    "dtype": d.Wrong({"int64": torch.int64, "bool": torch.bool, "of numpy": np.float32, "text": "float32"}),
}
MESSAGES = d.Wrong(
    {
        "masked": (1.0, "gps", MASKED),
        "a masked noise": (1.0, "gps", [1.0], MASKED),
        "a masked stamp": (MASKED[0], "gps", [1.0]),
        "no stamp": (None, "gps", [1.0]),
        "a stamp of text": ("now", "gps", [1.0]),
        "a stamp in a list": ([1.0], "gps", [1.0]),
        "a stamp of nan": (NAN, "gps", [1.0]),
        "no value": (1.0, "gps", None),
        "a value of text": (1.0, "gps", "north"),
        "a matrix": (1.0, "gps", [[1.0]]),
        "a noise of text": (1.0, "gps", [1.0], "wide"),
        "a noise of nan": (1.0, "gps", [1.0], [NAN]),
        "two numbers": (1.0, "gps", [1.0, 2.0]),
        "a number": 3.0,
        "text": "gps",
        "nothing": None,
        "a dictionary": {"stamp": 1.0},
    }
)


# ----------------------------------------------------------------------------------------------------------- LeRobot


@cache
def _robots() -> Path:
    root = workshop() / "robots"
    root.mkdir()
    apart(lambda: (write_version_2(root / "robot", [40, 9, 7, 8]), write_version_3(root / "newer", [[40, 9], [7, 8]])))
    return root


def _robot(folder: Path, name: str = "robot") -> Path:
    return d.copied(_robots() / name, folder)


def _replay(root: Path, **options: Any) -> Any:
    return LeRobotReplay(root, split="all", size=(12, 16), cache=None, progress=False, **options)[:]


def _length(episode: int, length: int) -> d.Change:
    """Another length in the list of episodes, of version 2."""

    def act(root: Path) -> None:
        file = root / "meta/episodes.jsonl"
        entries = [json.loads(line) for line in file.read_text().splitlines()]
        entries[episode]["length"] = length
        file.write_text("\n".join(map(json.dumps, entries)))

    return act


def _info(**changes: Any) -> d.Change:
    return lambda root: edited(lambda content: content.update(changes))(root / "meta/info.json")


def _renamed(name: str) -> d.Change:
    def act(root: Path) -> None:
        def rename(content: dict) -> None:
            content["features"][name] = content["features"].pop("action")

        edited(rename)(root / "meta/info.json")

    return act


def _lost(pattern: str) -> d.Change:
    return lambda root: [file.unlink() for file in sorted(root.glob(pattern))[1:]]


CONTRADICTIONS: dict[str, tuple[d.Change, tuple[str, ...]]] = {
    "an episode of no length": (_length(1, 0), ("metadata",)),
    "an episode of another length": (_length(1, 5), ("metadata",)),
    "twice the fps": (_info(fps=20), ("fps",)),
    "half the fps": (_info(fps=5), ("fps",)),
    "more episodes in all": (_info(total_episodes=50), ("total_episodes",)),
    "more frames in all": (_info(total_frames=5000), ("total_frames",)),
    "totals of text": (_info(total_episodes="many"), ("total_episodes",)),
    "actions": (_renamed("actions"), ("actions",)),
    "commands": (_renamed("observation.command"), ("observation.command",)),
    "videos that are missing": (_lost("videos/**/*.mkv"), ("episodes",)),
    "tables that are missing": (_lost("data/**/*.parquet"), ("episodes",)),
}
CHOICES = {
    "episodes": d.Wrong(
        {"unknown": [9], "none": [], "a number": 3, "text": "0", "a fraction": [0.5], "nested": [[0]]},
        d.drawn(st.integers(4, 99)).map(lambda one: (one[0], [one[1]])),
    ),
    "origin": d.of(3.0, {"joints": 1.0}, {"state": NAN}, {"state": [1.0, 2.0]}),
}


def _some(value: Any, folder: Path, name: str, argument: str) -> Any:
    return _replay(_robots() / name, **{argument: value})


def _whole(result: Any) -> bool:
    """Right where the episodes that are there are read: the first one."""
    return len(result) == 40 and bool(result["observed"].all())


def targets() -> Iterator[Target]:
    """Times, numbers, repeats, what drives, single messages, and recordings that contradict themselves."""
    yield from _times()
    yield Target("logs", "large numbers of a table", ("run.csv",), told(_large_table), LARGE)
    yield Target("logs", "large numbers of messages", ("gps[0]",), told(_large_messages), LARGE)
    yield Target(
        "logs", "large numbers of joints", ("origin",), told(_large_joints), LARGE.but("small numbers"), needs=_robots
    )
    yield Target("logs", "a fix that is repeated", ("repeats",), told(_repeated), HELD)
    yield Target("logs", "a slow column", ("repeats",), told(_mixed), HELD)
    dropped = told(partial(_repeated, repeats="drop"))
    yield Target("logs", "a fix that is dropped", ("repeats",), dropped, HELD, _dropped)
    yield Target("logs", "an IMU", ("imu", "gps"), told(_drive), DRIVING)
    yield Target("logs", "a message", ("gps", "Message"), told(_one), MESSAGES)
    for name, wrong in OPTIONS.items():
        act = told(lambda value, folder, name=name: _log(**{name: value}))
        yield Target("logs", f"message_rows({name})", (name, "delay"), act, wrong)
    for what, (change, words) in CONTRADICTIONS.items():
        act = told(lambda change, folder: (root := _robot(folder), change(root), _replay(root))[-1])
        yield Target("logs", f"robot: {what}", words, act, d.Wrong({"damaged": change}), needs=_robots)
    lost = d.Wrong({"videos": _lost("videos/**/*.mkv"), "tables": _lost("data/**/*.parquet")})
    act = told(lambda change, folder: (root := _robot(folder), change(root), _replay(root, episodes=[0]))[-1])
    yield Target("logs", "robot: episodes that are whole", ("episodes",), act, lost, _whole, needs=_robots)
    for name in ("robot", "newer"):
        for argument, wrong in CHOICES.items():
            act = told(partial(_some, name=name, argument=argument))
            yield Target("logs", f"LeRobotReplay({argument}) of {name}", (argument,), act, wrong, needs=_robots)
