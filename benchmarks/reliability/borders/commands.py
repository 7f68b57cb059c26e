"""The words of the command ``denkf``, and the files that they name."""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

import torch_denkf.cli.command as command_module
from benchmarks.reliability import damage as d
from benchmarks.reliability.borders import kitti, pretrained, ur5
from benchmarks.reliability.case import Refused, apart, workshop
from benchmarks.reliability.damage import copied, gone
from benchmarks.reliability.documents import WORDS, edited
from benchmarks.reliability.target import Target
from torch_denkf.applications.car import track
from torch_denkf.applications.car.odometry.checkpoint import load_car_filter
from torch_denkf.applications.car.odometry.paths import write_path
from torch_denkf.cli.main import main

WITHIN = 60.0


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
    for source in (kitti.sound(), ur5.sound(), pretrained.FOLDERS["car-odometry"]):
        copied(source, root)

    def path() -> None:
        import cv2

        frames = [cv2.imread(str(file)) for file in sorted((root / "kitti" / kitti.IMAGES).iterdir())]
        car = load_car_filter(root / "car-odometry")
        for _ in write_path(track(car, frames, (41.7, 41.7, 35.5, 11.5), fps=10.0), root / "path.csv"):
            pass

    apart(path)
    return root


COMMANDS: dict[str, dict[str, Any]] = {
    "odometry": {
        "": f"kitti/{kitti.IMAGES}",
        "--calibration": f"kitti/{kitti.CALIBRATION_FILE}",
        "--times": f"kitti/{kitti.TIME_FILE}",
        "--checkpoint": "./car-odometry",
        "--out": "out",
        "--no-pictures": None,
    },
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
FRACTIONS = st.floats(0.01, 9.99).map(lambda number: round(number, 2)).filter(lambda number: number % 1)
BELOW = st.integers(-(10**6), -1).map(str)
PITCH = d.of("x", "nan", "inf")
NUMBER = d.Wrong({**PITCH.named, "negative": "-1"}, d.drawn(BELOW))
WHOLE = d.Wrong({"text": "x", "a fraction": "1.5", "negative": "-1"}, d.drawn(FRACTIONS.map(str) | BELOW))
POSITIVE, AT_LEAST_ONE = NUMBER | {"zero": "0"}, WHOLE | {"zero": "0"}
NO_FOLDER = d.of("path.csv", "path.csv/below", "/dev/null/x")
NOTHING = d.of("nowhere", "")
NO_FILE = NOTHING | {"a folder": "kitti", "another file": "path.csv"}
WITHOUT_DRIVES = {"a folder without drives": "ur5"}
#: Wrong values of options, where they mean the same in all commands.
OPTIONS = {
    "--out": NO_FOLDER,
    "--calibration": NO_FILE,
    "--times": NO_FILE,
    "--checkpoint": NOTHING | {"a folder without one": "kitti"},
    "--camera": d.of("image_9"),
    "--size": d.of("0 10", "-4 10", "10", "a b"),
    "--pitch": PITCH,
    **dict.fromkeys(("--height", "--fps", "--focal"), POSITIVE),
    **dict.fromkeys(("--seed", "--sensor-updates", "--filter-updates", "--end-to-end-updates"), WHOLE),
    **dict.fromkeys(("--threads", "--processes", "--draws", "--window", "--frames", "--length"), AT_LEAST_ONE),
    **dict.fromkeys(("--demos", "--max-steps", "--every"), AT_LEAST_ONE),
}


def _of(shared: str, /, **own: d.Wrong | dict[str, str]) -> dict[str, d.Wrong]:
    """The options of a command by name, and those whose wrong values are its own."""
    given = {f"--{name.replace('_', '-')}": wrong for name, wrong in own.items()}
    wrong = {name: values if isinstance(values, d.Wrong) else d.Wrong(values) for name, values in given.items()}
    return {f"--{name}": OPTIONS[f"--{name}"] for name in shared.split()} | wrong


WRONG: dict[str, dict[str, d.Wrong]] = {
    "odometry": {
        "": d.Wrong(
            {"not there": "nowhere", "a text file": f"kitti/{kitti.TIME_FILE}", "an empty folder": "kitti/poses"}
        ),
        **_of(
            "calibration times checkpoint out camera height seed threads fps",
            pitch=PITCH | {"a right angle": "1.5708"},
            black_level=WHOLE | {"beyond 255": "300"},
            nothing={"no such option": "1"},
        ),
    },
    "evaluate": _of(
        "checkpoint out camera size height pitch draws window seed threads",
        root=NOTHING | WITHOUT_DRIVES | {"a file": "path.csv"},
        drives={"unknown": "nope", "outside": "../../etc"},
        missing=NUMBER | {"beyond one": "1.5"},
    ),
    "plot": {
        "": d.of("nowhere", "kitti"),
        **_of("out", level=POSITIVE | {"one": "1"}),
    },
    "render-kitti": _of(
        "out size frames seed camera focal processes",
        poses=NOTHING | {"a folder without poses": "ur5", "a file": "path.csv"},
        names={"outside": "../../x", "absolute": "/tmp/fuzz-outside", "empty": "", "a dot": "."},
    ),
    "train": _of(
        "out frames size height sensor-updates filter-updates end-to-end-updates length seed threads processes",
        root=NOTHING | WITHOUT_DRIVES,
        test={"unknown": "nope"},
        rendered=WHOLE | {"one": "1"},
        device={"unknown": "abacus", "not there": "cuda:77"},
    ),
    "collect-ur5": _of(
        "out demos seed max-steps processes",
        size={"zero": "0", "negative": "-4", "three numbers": "4 4 4", "text": "x"},
        frames=WHOLE,
        domain={"unknown": "moon"},
        tasks={"unknown": "juggle", "twice": "pick pick"},
        noise=NUMBER,
    ),
    "demo": _of(
        "out every threads",
        root={"without a drive": "kitti"},
        drive={"without a root": "town"},
        height={"text": "x"},
        frames=AT_LEAST_ONE | {"too few": "10"},
        seed={"text": "x", "negative": "-1"},
    ),
}
ALSO: dict[tuple[str, str], tuple[str, ...]] = {
    ("odometry", ""): ("FRAMES_OR_VIDEO",),
    ("plot", ""): ("FRAMES_OR_VIDEO",),
    ("odometry", "--times"): ("fps",),
    ("odometry", "--fps"): ("times",),
    ("render-kitti", "--names"): ("name",),
    ("train", "--rendered"): ("--root",),
    ("train", "--root"): ("sequences",),
    ("evaluate", "--root"): ("sequences",),
    ("evaluate", "--drives"): ("sequences", "poses"),
    ("demo", "--root"): ("--drive",),
    ("demo", "--drive"): ("--root",),
}
NEEDED = {
    "odometry": ("--calibration", "--out"),
    "evaluate": ("--root",),
    **dict.fromkeys(("render-kitti", "train", "collect-ur5"), ("--out",)),
}
LEFT_OUT = object()


def _words(name: str, given: dict[str, Any]) -> list[str]:
    words = [name]
    for option, value in given.items():
        whole = option in ("", "--out", "--root", "--poses")  # others take several words
        parts = [] if value is None else [value] if whole else str(value).split(" ")
        words += ([option] if option else []) + list(map(str, parts))
    return words


def _nothing(root: Path) -> None:
    """No damage but that of the words."""


def act(name: str, changes: dict[str, Any], change: d.Change, folder: Path) -> str:
    """Returns what a command says of a changed copy, with changed words."""
    root = copied(base(), folder)
    change(root)
    given = {option: value for option, value in {**COMMANDS[name], **changes}.items() if value is not LEFT_OUT}
    with contextlib.chdir(root):
        return run(_words(name, given))


def _as_without_damage(name: str, changes: dict[str, Any], said: str) -> bool:
    """Right where a command says word for word what it says of sound files, and warns of nothing."""
    return said == act(name, changes, _nothing, Path.cwd() / "again")


def _half_of_the_drive(root: Path) -> None:
    """A drive of which there are five frames, and as many poses."""
    d.written(d.BYTES.named["cut in half"])(root / "kitti" / kitti.POSE_FILE)
    for number in range(5, kitti.FRAMES):
        gone(root / "kitti" / kitti.IMAGES / f"{number:06d}.png")


def _as_of_half_the_drive(said: str) -> bool:
    """Right where images without poses are warned of, and the rest is as of a drive without these images."""
    warning, _, table = said.partition("\n")
    shorter = act("evaluate", {}, _half_of_the_drive, Path.cwd() / "again")
    return "town.txt has 5 poses" in warning and "5 of 10 images" in warning and table == shorter


FILTER = ("car-odometry/config.json", "car-odometry/weights.safetensors")
FILES: dict[str, tuple[str, ...]] = {
    "odometry": (f"kitti/{kitti.CALIBRATION_FILE}", f"kitti/{kitti.TIME_FILE}", *FILTER),
    "evaluate": (f"kitti/{kitti.POSE_FILE}", f"kitti/{kitti.CALIBRATION_FILE}", FILTER[0]),
    "plot": ("path.csv",),
    "collect-ur5": (f"ur5/{ur5.DEMO}", f"ur5/{ur5.MANIFEST}"),
}
PATH: dict[str, d.Change] = {
    **{f"a cell of {value}": d.put((3, 2), value) for value in ("far", "nan")},
    "a cell less": d.put((3,), lambda row: row[:-1]),
    "only a header": lambda rows: rows[:1],
    "another header": d.put((0,), ["a", "b", "c"]),
}
#: What each of three poses may be: three of them are a drive.
POSES: dict[str, d.Change] = {
    **{f"{value} in place {place}": d.put((1, place), value) for value in WORDS.named.values() for place in (0, 3)},
    **{f"pose 1 {what}": d.put((1,), change) for what, change in kitti.POSES.without("an empty line").named.items()},
    "eleven numbers": d.put((1, 11), d.MISSING),
    "three poses 1e7 m apart": lambda rows: [[*row[:11], str(1e7 * number)] for number, row in enumerate(rows)],
}


def _target(name: str, what: str, file: str, wrong: d.Wrong, changes: Any = None, **more: Any) -> Target:
    """Changes of a file that a command reads."""

    def damaged(change: d.Change, folder: Path) -> str:
        return act(name, changes or {}, lambda root: change(root / file), folder)

    options = {"within": WITHIN, "needs": base, **more}
    return Target("commands", f"{name}, {what}", (Path(file).name,), damaged, wrong, **options)


def _files() -> Iterator[Target]:
    # Of a table's or a description's last byte, which ends a line, nothing depends; of calib.txt, rows of other
    # cameras may be damaged.
    def rights(name: str, file: str, changes: dict[str, Any]) -> Callable[[str, Any], Any]:
        def right(what: str, change: Any) -> Any:
            if (name, file, what) == ("evaluate", f"kitti/{kitti.POSE_FILE}", "cut in half"):
                return _as_of_half_the_drive
            ended = what == "cut by a byte" and not file.endswith((".npz", ".safetensors"))
            other_rows = file.endswith("calib.txt") and "UTF" not in what and what != "taken away"
            return partial(_as_without_damage, name, changes) if ended or other_rows else None

        return right

    wrong = d.BYTES.but().each(d.written) | {"taken away": gone}
    for name, files in FILES.items():
        changes = {} if name != "collect-ur5" else {"--out": "ur5", "--verify": None}
        for file in files:
            yield _target(name, Path(file).name, file, wrong, changes, rights=rights(name, file, changes))
    yield _target("plot", "path.csv's lines", "path.csv", d.Wrong(PATH).each(edited))
    three = d.Wrong(POSES).each(lambda change: edited(lambda rows: (some := rows[:3], change(some) or some)[1]))
    given = {"--poses": "kitti/poses", "--names": "town"}
    yield _target("render-kitti", "pose 1", f"kitti/{kitti.POSE_FILE}", three, given, within=20.0)


def targets() -> Iterator[Target]:
    """All words and files."""
    for name, options in WRONG.items():
        for option, wrong in options.items():
            other = {"--times": LEFT_OUT} if (name, option) == ("odometry", "--fps") else {}
            use = lambda value, folder, name=name, option=option, other=other: (  # noqa: E731
                act(name, {option: value, **other}, _nothing, folder)
            )
            words = (option, option.removeprefix("--").replace("-", "_"), *ALSO.get((name, option), ()))
            given = {"within": WITHIN, "needs": base, "said": True}
            yield Target("commands", f"{name} {option}", tuple(filter(None, words)), use, wrong, **given)
        for option in NEEDED.get(name, ()):
            use = lambda option, folder, name=name: act(name, {option: LEFT_OUT}, _nothing, folder)  # noqa: E731
            without = d.Wrong({"left out": option})
            yield Target("commands", f"{name} without {option}", (option,), use, without, within=WITHIN, needs=base)
    no_words = d.of(["fly"], ["info", "--loud"])
    yield Target("commands", "words", ("fly", "--loud"), lambda words, folder: run(words), no_words)
    yield from _files()
