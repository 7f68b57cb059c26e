"""Arguments of the command ``denkf``, and files that they name."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import Any
from unittest.mock import patch

import cv2
from hypothesis import strategies as st

import torch_denkf.cli.command as command_module
from benchmarks.reliability import damage as d
from benchmarks.reliability.case import Refused
from benchmarks.reliability.damage import gone, put
from benchmarks.reliability.documents import WORDS, edited
from benchmarks.reliability.target import Source, Target
from tests.borders import kitti, models, ur5
from tests.borders.folders import made
from tests.borders.kitti import CALIBRATION_FILE, DRIVE, IMAGES, POSE_FILE, TIME_FILE
from tests.borders.ur5 import DEMO, MANIFEST
from torch_denkf.applications.car import track
from torch_denkf.applications.car.odometry.checkpoint import load_car_filter
from torch_denkf.applications.car.odometry.paths import write_path
from torch_denkf.cli.main import commands, main


def run(words: Sequence[str]) -> str:
    """Runs a command, and returns its warnings and output; raises its error.

    Raises:
        Refused: where it ends with a message of argparse, or finds something that is not in order.
        Exception: that whose message it ends with.
    """

    def again(message: str) -> int:
        raise

    out, err = io.StringIO(), io.StringIO()
    with (
        patch.object(command_module, "_mistake", again),
        warnings.catch_warnings(),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        warnings.simplefilter("default")
        code = main(list(words))
    if code:
        raise Refused(err.getvalue() + out.getvalue())
    warned = [line for line in err.getvalue().splitlines(True) if line.startswith("warning: ")]
    return "".join(warned) + out.getvalue()


def _write(root: Path) -> None:
    """Writes a drive, demos, a trained filter, and an estimated path."""
    for source in (kitti.drives(), ur5.demos(), models.FOLDERS["car-odometry"]):
        d.copied(source, root)
    frames = [cv2.imread(str(file)) for file in sorted((root / "kitti" / IMAGES).iterdir())]
    found = track(load_car_filter(root / "car-odometry"), frames, (41.7, 41.7, 35.5, 11.5), fps=10.0)
    for _ in write_path(found, root / "path.csv"):
        pass


def base() -> Path:
    """Returns the folder in which commands are run, with its files."""
    kitti.drives(), ur5.demos()
    return _work()


_work = made("work", _write)
#: Commands that succeed.
COMMANDS: dict[str, str] = {
    "odometry": f"kitti/{IMAGES} --calibration kitti/{CALIBRATION_FILE} --times kitti/{TIME_FILE} "
    "--checkpoint ./car-odometry --out out --no-pictures",
    "evaluate": "--checkpoint ./car-odometry --root kitti --draws 1 --window 3 --out out",
    "plot": "path.csv --out out",
    "render-kitti": "--out out --names a --frames 3 --size 12 36 --processes 1",
    "train": "--out out --rendered 3 --frames 12 --sensor-updates 1 --filter-updates 1 --end-to-end-updates 1 "
    "--length 3 --processes 1",
    "collect-ur5": "--out out --demos 1 --no-pixels --max-steps 4 --processes 1",
    "demo": "--out out --frames 30",
}
LEFT_OUT = object()


def words(name: str, changes: dict[str, Any]) -> list[str]:
    """Returns a command's arguments, with other values of some options; "" is the positional one."""
    given: dict[str, list[str]] = {}
    for word in COMMANDS[name].split():
        option = word if word.startswith("--") else next(reversed(given), "")
        given.setdefault(option, []).extend([] if option == word else [word])
    for option, value in changes.items():
        whole = option in ("", "--out", "--root", "--poses")  # others take several words
        given[option] = [value] if whole else [] if value is None else str(value).split(" ")
    used = {option: parts for option, parts in given.items() if changes.get(option) is not LEFT_OUT}
    return [name, *(word for option, parts in used.items() for word in ([option] if option else []) + parts)]


def called(folder: Path, /, name: str, **changes: Any) -> str:
    """Runs a command in a folder and returns its output; changes are named as its fields."""
    changes = {"" if option == "first" else f"--{option.replace('_', '-')}": value for option, value in changes.items()}
    with contextlib.chdir(folder):
        return run(words(name, changes))


CALLED = {name: Source("commands", base, partial(called, name=name), f"{name}, ") for name in COMMANDS}


# ----------------------------------------------------------------------------------------------------------- options

FRACTIONS = st.floats(0.01, 9.99).map(lambda number: round(number, 2)).filter(lambda number: number % 1)
BELOW = st.integers(-(10**6), -1).map(str)
PITCH = d.of("x", "nan", "inf")
NUMBER = PITCH | d.of("-1", others=BELOW)
WHOLE = d.of("x", "1.5", "-1", others=FRACTIONS.map(str) | BELOW)
POSITIVE, AT_LEAST_ONE = NUMBER | d.of("0"), WHOLE | d.of("0")
NOTHING, WITHOUT_DRIVES = d.of("nowhere", ""), d.of("ur5")
#: Wrong values of options, where they mean the same in all commands.
OPTIONS: dict[str, d.Wrong] = {
    "out": d.of("path.csv", "path.csv/below", "/dev/null/x"),
    **dict.fromkeys(("calibration", "times"), NOTHING | d.of("kitti", "path.csv")),
    "checkpoint": NOTHING | d.of("kitti"),
    "camera": d.of("image_9"),
    "size": d.of("0 10", "-4 10", "10", "a b"),
    "pitch": PITCH,
    **dict.fromkeys(("height", "fps", "focal"), POSITIVE),
    "level": POSITIVE | d.of("1"),
    **dict.fromkeys(("seed", "sensor_updates", "filter_updates", "end_to_end_updates"), WHOLE),
    "rendered": WHOLE | d.of("1"),
    "black_level": WHOLE | d.of("300"),
    **dict.fromkeys(("threads", "processes", "draws", "window", "frames", "length"), AT_LEAST_ONE),
    **dict.fromkeys(("demos", "max_steps", "every"), AT_LEAST_ONE),
    "root": NOTHING | WITHOUT_DRIVES,
    "poses": NOTHING | WITHOUT_DRIVES | d.of("path.csv"),
    "names": d.of("../../x", "/tmp/fuzz-outside", "", "."),
    "missing": NUMBER | d.of("1.5"),
    "noise": NUMBER,
    "test": d.of("nope"),
    "device": d.of("abacus", "cuda:77"),
    "domain": d.of("moon"),
    "tasks": d.of("juggle", "pick pick"),
}
#: Those of a single command.
OWN: dict[tuple[str, str], d.Wrong] = {
    ("odometry", "frames"): d.of("nowhere", f"kitti/{TIME_FILE}", "kitti/poses"),
    ("odometry", "pitch"): PITCH | d.of("1.5708"),
    ("odometry", "nothing"): d.of("1"),
    ("evaluate", "root"): OPTIONS["root"] | d.of("path.csv"),
    ("evaluate", "drives"): d.of("nope", "../../etc"),
    ("plot", "path"): d.of("nowhere", "kitti"),
    ("collect-ur5", "size"): d.of("0", "-4", "4 4 4", "x"),
    ("collect-ur5", "frames"): WHOLE,
    ("render-kitti", "frames"): AT_LEAST_ONE | d.of("1"),
    ("render-kitti", "focal"): POSITIVE | d.of("718.856"),
    ("demo", "root"): d.of("kitti"),
    ("demo", "drive"): d.of("town"),
    ("demo", "height"): d.of("x"),
    ("demo", "frames"): AT_LEAST_ONE | d.of("10"),
    ("demo", "seed"): d.of("x", "-1"),
}
#: Other words by which a message may name an option.
ALSO: dict[str, tuple[str, ...]] = {
    "first": ("FRAMES_OR_VIDEO",),
    "times": ("fps",),
    "fps": ("times",),
    "names": ("name",),
    "rendered": ("--root",),
    "root": ("sequences", "--drive"),
    "drives": ("sequences", "poses"),
    "drive": ("--root",),
}


def _options(name: str) -> Iterator[Target]:
    source, command = CALLED[name], resolve_name(commands()[name][0])
    fields = {field.name: field for field in dataclasses.fields(command)}
    for option in [*fields, *(other for of, other in OWN if of == name and other not in fields)]:
        first = option in fields and "Positional" in str(fields[option].type)
        given, flag = "first" if first else option, f"--{option.replace('_', '-')}"
        also = {"times": LEFT_OUT} if (name, option) == ("odometry", "fps") else {}
        said = (*([] if first else [flag, option]), *ALSO.get(given, ()))
        act = lambda value, folder, given=given, also=also: source.damaged(  # noqa: E731
            lambda root: None, folder, **{given: value}, **also
        )
        wrong = OWN.get((name, option), OPTIONS.get(option))
        if wrong:
            yield Target("commands", f"{name} {option}", said, act, wrong, within=60, needs=base, said=True)
        if option in fields and fields[option].default is dataclasses.MISSING and not first:
            left = d.Wrong({"left out": LEFT_OUT})
            yield Target("commands", f"{name} without {option}", said, act, left, within=60, needs=base)


# ------------------------------------------------------------------------------------------------------------- files


def _half_of_the_drive(root: Path) -> None:
    """Removes half of a drive: five frames and five poses remain."""
    d.BYTES.named["cut in half"](root / "kitti" / POSE_FILE)
    for number in range(5, kitti.FRAMES):
        gone(root / "kitti" / IMAGES / f"{number:06d}.png")


def _as_of_half_the_drive(said: str) -> bool:
    """Tells whether images without poses are warned of, and the rest is as of a drive without these images."""
    warning, _, table = said.partition("\n")
    shorter = CALLED["evaluate"].damaged(_half_of_the_drive)
    return "town.txt has 5 poses" in warning and "5 of 10 images" in warning and table == shorter


#: Files that commands read, and the options for them.
FILES: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("odometry", f"kitti/{CALIBRATION_FILE}", {}),
    ("odometry", f"kitti/{TIME_FILE}", {}),
    ("odometry", "car-odometry/config.json", {}),
    ("odometry", "car-odometry/weights.safetensors", {}),
    ("evaluate", f"kitti/{POSE_FILE}", {}),
    ("evaluate", f"kitti/{CALIBRATION_FILE}", {}),
    ("evaluate", "car-odometry/config.json", {}),
    ("plot", "path.csv", {}),
    ("collect-ur5", f"ur5/{DEMO}", {"out": "ur5", "verify": None}),
    ("collect-ur5", f"ur5/{MANIFEST}", {"out": "ur5", "verify": None}),
)
PATH: dict[str, d.Change] = {
    **{f"a cell of {value}": put((3, 2), value) for value in ("far", "nan")},
    "a cell less": put(3, lambda row: row[:-1]),
    "only a header": lambda rows: rows[:1],
    "another header": put(0, ["a", "b", "c"]),
}
#: Valid changes of each of three poses.
POSES: dict[str, d.Change] = {
    **{f"{value} in place {place}": put((1, place), value) for value in WORDS.named.values() for place in (0, 3)},
    **{f"pose 1 {what}": put(1, change) for what, change in kitti.POSES.items() if what != "an empty line"},
    "eleven numbers": put((1, 11), d.MISSING),
    "three poses 1e7 m apart": lambda rows: [[*row[:11], str(1e7 * number)] for number, row in enumerate(rows)],
}


def _rights(source: Source, file: str, options: dict[str, Any]) -> Callable[[str, Any], Any]:
    """Tells whether a command prints exactly its output for undamaged files, without warnings.

    Nothing depends on the last byte of a table or a description, which ends a line; of calib.txt, rows of other cameras
    may be damaged.
    """

    def equal(said: str) -> bool:
        return said == source.damaged(lambda root: None, **options)

    def right(what: str, change: Any) -> Any:
        if (source.name, file, what) == ("evaluate, ", f"kitti/{POSE_FILE}", "cut in half"):
            return _as_of_half_the_drive
        ended = what == "cut by a byte" and not file.endswith((".npz", ".safetensors"))
        other_rows = file.endswith("calib.txt") and "UTF" not in what and what != "taken away"
        return equal if ended or other_rows else None

    return right


def targets() -> Iterator[Target]:
    """Yields all words and files."""
    for name in COMMANDS:
        yield from _options(name)
    act, no_words = (lambda words, folder: run(words)), d.of(["fly"], ["info", "--loud"])
    yield Target("commands", "words", ("fly", "--loud"), act, no_words)
    wrong = d.BYTES.but() | {"taken away": gone}
    for name, file, options in FILES:
        rights = _rights(CALLED[name], file, options)
        yield CALLED[name].target(Path(file).name, wrong, file=file, options=options, rights=rights, within=60)
    yield CALLED["plot"].target("path.csv's lines", d.Wrong(PATH).each(edited), file="path.csv")
    three = d.Wrong(POSES).each(lambda change: edited(lambda rows: (some := rows[:3], change(some) or some)[1]))
    drive = {"poses": "kitti/poses", "names": DRIVE}
    yield CALLED["render-kitti"].target("pose 1", three, file=f"kitti/{POSE_FILE}", options=drive)
