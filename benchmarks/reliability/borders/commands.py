"""The words of the command ``denkf``, and the files that they name."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch_denkf.cli._command as command_module
from benchmarks.reliability.borders import kitti, pretrained, ur5
from benchmarks.reliability.case import Case, Refused, apart, workshop
from benchmarks.reliability.damage import BYTES, copied, gone, written
from torch_denkf.cli.main import main
from torch_denkf.odometry import load_car_filter, track, write_path

WITHIN = 60.0
Change = Callable[[Path], Any]


def run(words: Sequence[str]) -> str:
    """Runs a command: its warnings and what it says, or the error that it ends with.

    Raises:
        Refused: where it ends with a message of argparse, or finds something that is not in order.
        Exception: that whose message it ends with.
    """

    def again(message: str) -> int:
        raise

    command_module._mistake = again  # of this process alone, as what follows
    warnings.simplefilter("default")
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main(list(map(str, words)))
    if code:
        raise Refused(err.getvalue() + out.getvalue())
    warned = [line for line in err.getvalue().splitlines(True) if line.startswith("warning: ")]
    return "".join(warned) + out.getvalue()


@cache
def base() -> Path:
    """A folder with a drive, demos, a path, and a trained filter."""
    root = workshop() / "work"
    root.mkdir()
    for source in (kitti.sound(), ur5.sound(), pretrained.FOLDERS / "car-odometry"):
        copied(source, root)

    def path() -> None:
        import cv2

        images = sorted(kitti.image(root / "kitti").parent.iterdir())
        frames = [cv2.imread(str(file)) for file in images]
        car = load_car_filter(root / "car-odometry")
        for _ in write_path(track(car, frames, (41.7, 41.7, 35.5, 11.5), fps=10.0), root / "path.csv"):
            pass

    apart(path)
    return root


DRIVE = "kitti/sequences/town"
ODOMETRY = {
    "": f"{DRIVE}/image_2",
    "--calibration": f"{DRIVE}/calib.txt",
    "--times": f"{DRIVE}/times.txt",
    "--checkpoint": "./car-odometry",
    "--out": "out",
    "--no-pictures": None,
}
COMMANDS: dict[str, dict[str, Any]] = {
    "odometry": ODOMETRY,
    "evaluate": {"--checkpoint": "./car-odometry", "--root": "kitti", "--draws": 1, "--window": 3, "--out": "out"},
    "plot": {"": "path.csv", "--out": "out"},
    "render-kitti": {"--out": "out", "--names": "a", "--frames": 3, "--size": "12 36", "--processes": 1},
    "train": {
        "--out": "out",
        "--rendered": 3,
        "--frames": 12,
        "--sensor-updates": 1,
        "--filter-updates": 1,
        "--end-to-end-updates": 1,
        "--length": 3,
        "--processes": 1,
    },
    "collect-ur5": {"--out": "out", "--demos": 1, "--no-pixels": None, "--max-steps": 4, "--processes": 1},
    "demo": {"--out": "out", "--frames": 30},
}
NUMBER = {"text": "x", "nan": "nan", "inf": "inf", "negative": "-1"}
WHOLE = {"text": "x", "a fraction": "1.5", "negative": "-1"}
POSITIVE = {**NUMBER, "zero": "0"}
AT_LEAST_ONE = {**WHOLE, "zero": "0"}
NO_FOLDER = {"a file": "path.csv", "in a file": "path.csv/below", "in a device": "/dev/null/x"}
NOTHING = {"not there": "nowhere", "empty": ""}
WRONG: dict[str, dict[str, dict[str, str]]] = {
    "odometry": {
        "": {"not there": "nowhere", "a text file": f"{DRIVE}/times.txt", "an empty folder": "kitti/poses"},
        "--calibration": {**NOTHING, "a folder": "kitti", "another file": "path.csv"},
        "--times": {**NOTHING, "a folder": "kitti", "another file": "path.csv"},
        "--checkpoint": {**NOTHING, "a folder without one": "kitti"},
        "--out": NO_FOLDER,
        "--camera": {"unknown": "image_9"},
        "--height": POSITIVE,
        "--pitch": {"text": "x", "nan": "nan", "inf": "inf", "a right angle": "1.5708"},
        "--seed": WHOLE,
        "--black-level": {**WHOLE, "beyond 255": "300"},
        "--threads": AT_LEAST_ONE,
        "--fps": POSITIVE,
        "--nothing": {"no such option": "1"},
    },
    "evaluate": {
        "--checkpoint": {**NOTHING, "a folder without one": "kitti"},
        "--root": {**NOTHING, "a file": "path.csv", "a folder without drives": "ur5"},
        "--drives": {"unknown": "nope", "outside": "../../etc"},
        "--out": NO_FOLDER,
        "--camera": {"unknown": "image_9"},
        "--size": {"zero": "0 10", "negative": "-4 10", "one number": "10", "text": "a b"},
        "--height": POSITIVE,
        "--pitch": {"text": "x", "nan": "nan", "inf": "inf"},
        "--missing": {**NUMBER, "beyond one": "1.5"},
        "--draws": AT_LEAST_ONE,
        "--window": AT_LEAST_ONE,
        "--seed": WHOLE,
        "--threads": AT_LEAST_ONE,
    },
    "plot": {
        "": {"not there": "nowhere", "a folder without one": "kitti"},
        "--out": NO_FOLDER,
        "--level": {**POSITIVE, "one": "1"},
    },
    "render-kitti": {
        "--out": NO_FOLDER,
        "--poses": {**NOTHING, "a folder without poses": "ur5", "a file": "path.csv"},
        "--names": {"outside": "../../x", "absolute": "/tmp/fuzz-outside", "empty": "", "a dot": "."},
        "--size": {"zero": "0 10", "negative": "-4 10", "one number": "10", "text": "a b"},
        "--frames": AT_LEAST_ONE,
        "--seed": WHOLE,
        "--camera": {"unknown": "image_9"},
        "--focal": POSITIVE,
        "--processes": AT_LEAST_ONE,
    },
    "train": {
        "--out": NO_FOLDER,
        "--root": {**NOTHING, "a folder without drives": "ur5"},
        "--test": {"unknown": "nope"},
        "--rendered": {**WHOLE, "one": "1"},
        "--frames": AT_LEAST_ONE,
        "--size": {"zero": "0 10", "negative": "-4 10", "one number": "10", "text": "a b"},
        "--height": POSITIVE,
        "--sensor-updates": WHOLE,
        "--filter-updates": WHOLE,
        "--end-to-end-updates": WHOLE,
        "--length": AT_LEAST_ONE,
        "--seed": WHOLE,
        "--device": {"unknown": "abacus", "not there": "cuda:77"},
        "--threads": AT_LEAST_ONE,
        "--processes": AT_LEAST_ONE,
    },
    "collect-ur5": {
        "--out": NO_FOLDER,
        "--demos": AT_LEAST_ONE,
        "--size": {"zero": "0", "negative": "-4", "three numbers": "4 4 4", "text": "x"},
        "--frames": WHOLE,
        "--domain": {"unknown": "moon"},
        "--tasks": {"unknown": "juggle", "twice": "pick pick"},
        "--seed": WHOLE,
        "--max-steps": AT_LEAST_ONE,
        "--noise": NUMBER,
        "--processes": AT_LEAST_ONE,
    },
    "demo": {
        "--out": NO_FOLDER,
        "--root": {"without a drive": "kitti"},
        "--drive": {"without a root": "town"},
        "--height": {"text": "x"},
        "--frames": {**AT_LEAST_ONE, "too few": "10"},
        "--every": AT_LEAST_ONE,
        "--seed": {"text": "x", "negative": "-1"},
        "--threads": AT_LEAST_ONE,
    },
}
ALSO: dict[tuple[str, str], tuple[str, ...]] = {
    ("odometry", "--times"): ("fps",),
    ("odometry", "--fps"): ("times",),
    ("render-kitti", "--names"): ("name", "names"),
    ("train", "--rendered"): ("--root",),
    ("train", "--root"): ("sequences",),
    ("evaluate", "--root"): ("sequences", "root"),
    ("evaluate", "--drives"): ("sequences", "poses"),
    ("demo", "--root"): ("--drive",),
    ("demo", "--drive"): ("--root",),
}

OPTIONAL = {("demo", "--out"), ("evaluate", "--out"), ("plot", "--out")}


def _words(name: str, given: dict[str, Any]) -> list[str]:
    words = [name]
    for option, value in given.items():
        parts = (
            [] if value is None else [value] if option in ("", "--out", "--root", "--poses") else str(value).split(" ")
        )
        words += ([option] if option else []) + list(map(str, parts))
    return words


def _act(name: str, changes: dict[str, Any], change: Change, folder: Path) -> str:
    root = copied(base(), folder)
    change(root)
    with contextlib.chdir(root):
        return run(_words(name, {**COMMANDS[name], **changes}))


def _nothing(root: Path) -> None:
    """No damage but that of the words."""


def _as_without_damage(name: str, changes: dict[str, Any], said: str) -> bool:
    """Right where a command says word for word what it says of sound files, and warns of nothing."""
    return said == _act(name, changes, _nothing, Path.cwd() / "again")


def _half_of_the_drive(root: Path) -> None:
    """A drive of which there are five frames, and as many poses."""
    written(kitti.poses(root / "kitti"), BYTES["cut in half"])
    for number in range(5, kitti.FRAMES):
        gone(kitti.image(root / "kitti", number))


def _as_of_half_the_drive(said: str) -> bool:
    """Right where images without poses are warned of, and the rest is as of a drive without these images."""
    warning, _, table = said.partition("\n")
    shorter = _act("evaluate", {}, _half_of_the_drive, Path.cwd() / "again")
    return "town.txt has 5 poses" in warning and "5 of 10 images" in warning and table == shorter


FILES: dict[str, tuple[str, ...]] = {
    "odometry": (
        f"{DRIVE}/calib.txt",
        f"{DRIVE}/times.txt",
        "car-odometry/config.json",
        "car-odometry/weights.safetensors",
    ),
    "evaluate": ("kitti/poses/town.txt", f"{DRIVE}/calib.txt", "car-odometry/config.json"),
    "plot": ("path.csv",),
    "collect-ur5": ("ur5/demo-000001.npz", "ur5/demos.jsonl"),
}


def _files() -> Iterator[Case]:
    for name, files in FILES.items():
        for file in files:
            for what, change in BYTES.items():
                # Of a table's or a description's last byte, which ends a line, nothing depends; of calib.txt, rows of
                # other cameras may be damaged.
                sound = ("cut by a byte" in what and not file.endswith((".npz", ".safetensors"))) or (
                    file.endswith("calib.txt") and "UTF" not in what
                )
                changes = {} if name != "collect-ur5" else {"--out": "ur5", "--verify": None}
                act = partial(_act, name, changes, lambda root, file=file, change=change: written(root / file, change))
                right = partial(_as_without_damage, name, changes) if sound else None
                if (name, file, what) == ("evaluate", "kitti/poses/town.txt", "cut in half"):
                    right = _as_of_half_the_drive
                yield Case(
                    "commands", f"{name}, {Path(file).name} {what}", (Path(file).name,), act, right, WITHIN, base
                )
            act = partial(_act, name, changes, lambda root, file=file: gone(root / file))
            yield Case("commands", f"{name}, {Path(file).name} taken away", (Path(file).name,), act, None, WITHIN, base)
    row: dict[str, Callable[[list[str]], list[str]]] = {
        "a cell of text": lambda lines: [*lines[:3], lines[3].replace(lines[3].split(",")[2], "far"), *lines[4:]],
        "a cell of nan": lambda lines: [*lines[:3], lines[3].replace(lines[3].split(",")[2], "nan"), *lines[4:]],
        "a cell less": lambda lines: [*lines[:3], lines[3].rsplit(",", 1)[0], *lines[4:]],
        "only a header": lambda lines: lines[:1],
        "another header": lambda lines: ["a,b,c", *lines[1:]],
    }
    for what, change in row.items():

        def rewrite(root: Path, change: Callable[[list[str]], list[str]] = change) -> None:
            file = root / "path.csv"
            file.write_text("\n".join(change(file.read_text().splitlines())) + "\n")

        act = partial(_act, "plot", {}, rewrite)
        yield Case("commands", f"plot, path.csv {what}", ("path.csv",), act, None, WITHIN, base)
    for what, change in {**kitti.POSES, "three poses 1e7 m apart": lambda line: line}.items():
        if what == "an empty line":
            continue

        def edit(root: Path, what: str = what, change: Callable[[str], str] = change) -> None:
            file = kitti.poses(root / "kitti")
            lines = file.read_text().splitlines()[:3]
            if what.startswith("three"):
                lines = [kitti._number(11, str(1e7 * k))(line) for k, line in enumerate(lines)]
            else:
                lines[1] = change(lines[1])
            file.write_text("\n".join(lines) + "\n")

        act = partial(_act, "render-kitti", {"--poses": "kitti/poses", "--names": "town"}, edit)
        yield Case("commands", f"render-kitti, pose 1: {what}", ("town.txt",), act, None, 20.0, base)


def cases() -> Iterator[Case]:
    """All damaged words and files."""
    for name, options in WRONG.items():
        for option, values in options.items():
            for what, value in values.items():
                changes = {option: value}
                if (name, option) == ("odometry", "--fps"):
                    changes["--times"] = None
                words = (
                    option or "FRAMES_OR_VIDEO",
                    option.removeprefix("--").replace("-", "_"),
                    value,
                    *ALSO.get((name, option), ()),
                )
                shown = _without_times if "--times" in changes and option == "--fps" else _act
                yield Case(
                    "commands",
                    f"{name} {option} {what}",
                    tuple(filter(None, words)),
                    partial(shown, name, changes, _nothing),
                    None,
                    WITHIN,
                    base,
                )
        for option in COMMANDS[name]:
            if option in ("--out", "--root", "--calibration") and (name, option) not in OPTIONAL:
                act = partial(_without, name, option)
                yield Case("commands", f"{name} without {option}", (option,), act, None, WITHIN, base)
    yield Case("commands", "an unknown command", ("fly",), lambda folder: run(["fly"]))
    yield Case("commands", "an option that is none", ("--loud",), lambda folder: run(["info", "--loud"]))
    yield from _files()


def _without(name: str, option: str, folder: Path) -> str:
    given = {key: value for key, value in COMMANDS[name].items() if key != option}
    with contextlib.chdir(copied(base(), folder)):
        return run(_words(name, given))


def _without_times(name: str, changes: dict[str, Any], change: Change, folder: Path) -> str:
    given = {key: value for key, value in {**COMMANDS[name], **changes}.items() if key != "--times"}
    with contextlib.chdir(copied(base(), folder)):
        return run(_words(name, given))
