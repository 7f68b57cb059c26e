"""Demonstrations of the UR5 table."""

from __future__ import annotations

import hashlib
import io
import warnings
import zipfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.case import workshop
from benchmarks.reliability.damage import gone, same
from benchmarks.reliability.documents import edited
from benchmarks.reliability.hostile import Bomb, npz_of_zeros
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos

ROWS = (6, 5, 7)
DEMO = "demo-000001.npz"
MANIFEST = "demos.jsonl"


@cache
def sound() -> Path:
    """Three demos."""
    root = workshop() / "ur5"
    root.mkdir()
    return write_folder(root, [make_demo(number, rows) for number, rows in enumerate(ROWS)])


def read(root: Path, **options: Any) -> TensorDict:
    """All rows, as a user reads them."""
    return UR5ExperienceReplay(root, **{"split": "all", "cache": None, "progress": False, **options})[:]


def _warned(root: Path) -> tuple[TensorDict, list[str]]:
    """The rows, and what was said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = read(root)
    return result, [str(warning.message) for warning in caught]


DEMOS = Folder("ur5", sound, read)
LISTED = Folder("ur5", sound, _warned)


def _all_or_said(result: tuple[TensorDict, list[str]]) -> bool:
    """Right where all demos are there, or the first ones, and a warning names the list that lacks the others."""
    rows, said = result
    return DEMOS.equal(rows) or (
        same(rows, DEMOS.reference()[: len(rows)]) and any(MANIFEST in message for message in said)
    )


def signed(change: d.Change) -> d.Change:
    """Changes a demo, and the manifest's checksum, as somebody with bad intentions would."""

    def act(file: Path) -> None:
        change(file)
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
        edited(d.put((1, "sha256"), sha256))(file.with_name(MANIFEST))

    return act


TEXTS = {
    "a line twice": lambda lines: [*lines, lines[1]],
    "one field more": d.put((1,), lambda line: {**line, "colour": "red"}),
    "another demo": d.put((1, "demo"), 7),
    "another demo's file": d.put((1, "file"), "demo-000000.npz"),
    "one row more": d.put((1, "rows"), 6),
    "one frame more": d.put((1, "frames"), 4),
    "no checksum of this": d.put((1, "sha256"), "0" * 64),
}
STEPS = {
    "beyond the rows": lambda array: array + 100,
    "negative": lambda array: array - 100,
    "the same twice": lambda array: np.full_like(array, 2),
    "not ascending": lambda array: array[::-1].copy(),
}
ARRAYS = {
    "task juggle": d.put(("task",), np.array("juggle")),
    "domain moon": d.put(("domain",), np.array("moon")),
    "number 7": d.put(("number",), np.array(7)),
    "state 1e30": d.put(
        ("state",), lambda array: np.where(np.arange(array.size).reshape(array.shape) == 7, 1e30, array)
    ),
    "pixels as floats": d.put(("pixels",), lambda array: array / 255),
    "an array more": lambda arrays: {**arrays, "extra": np.zeros(3)},
    **{f"steps {what}": d.put(("steps",), change) for what, change in STEPS.items()},
}


def _many(data: bytes) -> bytes:
    """An archive of 20,000 arrays."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for number in range(20000):
            archive.writestr(f"{number}.npy", b"")
    return buffer.getvalue()


def _files() -> Iterator[Target]:
    words = (MANIFEST, DEMO, "demo-000000.npz", "demo-000002.npz")
    yield LISTED.target("manifest", d.FILE, _all_or_said, file=MANIFEST)
    rows, loose = (lambda place: len(place) == 1), (lambda place: place[-1] == "failures")
    yield from DEMOS.document(MANIFEST, DEMOS.equal, words, skip=rows, loose=loose)
    twice = {"a line twice": DEMOS.equal}
    yield DEMOS.target("manifest's lines", d.Wrong(TEXTS).each(edited), None, words, MANIFEST, rights=twice)
    yield DEMOS.target("demo", d.SEALED.each(d.written) | d.PLACES, file=DEMO)
    sealed = d.BYTES.but().each(d.written).each(signed)
    yield DEMOS.target("demo, checksum adapted", sealed, DEMOS.equal, file=DEMO)  # nobody reads its date
    yield from DEMOS.document(DEMO, None, then=signed)
    yield DEMOS.target("demo's arrays", d.Wrong(ARRAYS).each(edited).each(signed), file=DEMO)
    hostile = {"with a pickle that runs code": lambda data: Bomb.npz("state"), "of 20,000 arrays": _many}
    hostile["that unpacks to a gigabyte"] = lambda data: npz_of_zeros(1 << 30)
    yield DEMOS.target("hostile demo", d.Wrong(hostile).each(d.written).each(signed), file=DEMO, within=4)
    yield DEMOS.one("no root", gone, "ur5")


ARGUMENTS = {
    "size": d.SIZE | {"larger": (500, 500), "fractions": (1.5, 2.5)},
    "split": d.of("best"),
    "validation_share": d.of(1.0, -1.0),
}
COLLECTION = {
    "demos": d.COUNT,
    "processes": d.COUNT.but("fraction"),
    "size": d.SIZE,
    "frames": d.COUNT_OR_NONE,
    "domain": d.of("moon"),
    "tasks": d.of(["juggle"], [], ["pick", "pick"]),
    "seed": d.COUNT_OR_NONE,
    "max_steps": d.COUNT.but("fraction"),
    "noise": d.NOT_NEGATIVE,
}


def _collected(**given: Any) -> Any:
    return collect_ur5_demos("out", **{"demos": 1, "frames": None, "max_steps": 4, **given})


def targets() -> Iterator[Target]:
    """All of a folder of demos, and the arguments of what reads and makes it."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    yield from _files()
    yield from targets_of(
        "ur5",
        DEMOS.arguments("UR5ExperienceReplay", wrong=ARGUMENTS),
        Subject(_collected, wrong=COLLECTION, name="collect_ur5_demos"),
    )
