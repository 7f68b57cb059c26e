"""Demonstrations of the UR5 table."""

from __future__ import annotations

import hashlib
import io
import warnings
import zipfile
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders.lerobot import json_line
from benchmarks.reliability.case import workshop
from benchmarks.reliability.damage import fields, gone, on_row, same
from benchmarks.reliability.hostile import Bomb, npz_of_zeros
from benchmarks.reliability.target import Folder, Subject, Target, targets_of
from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos

ROWS = (6, 5, 7)
DEMO = "demo-000001.npz"
MANIFEST = "demos.jsonl"
NAN, INF = float("nan"), float("inf")


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
    """Changes a demo's bytes, and the manifest's checksum, as somebody with bad intentions would."""

    def act(file: Path) -> None:
        data = change(file.read_bytes())
        file.write_bytes(data)
        sha256 = hashlib.sha256(data).hexdigest()
        json_line(1, lambda line: line.update(sha256=sha256))(file.with_name(MANIFEST))

    return act


def in_arrays(change: d.Change) -> d.Change:
    """Changes the arrays of a demo, and its checksum."""

    def act(data: bytes) -> bytes:
        with np.load(io.BytesIO(data)) as stored:
            arrays = dict(stored)
        change(arrays)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=True, **arrays)
        return buffer.getvalue()

    return signed(act)


ANOTHER = {
    "demo": d.types("text", "nothing", "negative", "a fraction", another=7),
    "file": d.Wrong(
        {
            "outside": "../../../etc/passwd",
            "absolute": "/etc/passwd",
            "another demo": "demo-000000.npz",
            "empty": "",
            "a number": 3,
            "a device": "/dev/zero",
        }
    ),
    "sha256": d.types("nothing", "negative", empty="", another="0" * 64),
    "rows": d.types("text", "nothing", "negative", "a fraction", zero=0, huge=10**12) | {"one more": 6},
    "frames": d.types("text", "nothing", "negative", huge=10**12) | {"one more": 4},
}
LINES = fields(ANOTHER) | {
    "a list": lambda line: [],
    "a number": lambda line: 3,
    "one field more": lambda line: line.update(colour="red"),
}
TEXTS = {
    "a line that is no JSON in the middle": on_row(0, lambda line: line + "\nnothing"),
    "the last line cut": on_row(-1, lambda line: line[:-40]),
    "a line twice": lambda lines: [*lines, lines[1]],
    "an empty line in the middle": on_row(0, lambda line: line + "\n"),
}


def _manifest() -> Iterator[Target]:
    words = (MANIFEST, DEMO, "demo-000000.npz")
    yield LISTED.target("manifest", d.FILE, _all_or_said, file=MANIFEST)
    yield DEMOS.target("manifest's line", LINES.each(partial(json_line, 1)), None, words, MANIFEST)
    failures = fields({"failures": d.types("text", "negative")})
    yield DEMOS.target("manifest's line of", failures.each(partial(json_line, 1)), DEMOS.equal, words, MANIFEST)
    yield LISTED.target("manifest's lines", d.Wrong(TEXTS).each(d.in_lines), _all_or_said, file=MANIFEST)


def _poked(value: float, place: tuple[int, int] = (2, 3)) -> d.Change:
    def change(array: np.ndarray) -> np.ndarray:
        out = array.copy()
        out[place] = value
        return out

    return change


OBJECT = {"an object": np.array([{}], dtype=object)}
COLUMN = d.Wrong(
    {
        **OBJECT,
        "a row less": lambda array: array[:-1],
        "a scalar": np.float32(3),
        "text": lambda array: np.full(array.shape, "x"),
    }
)
PLACES = st.tuples(st.integers(0, 4), st.integers(0, 3))
NUMBERS = COLUMN | d.Wrong(
    {"nan": _poked(np.nan), "inf": _poked(np.inf), "1e30": _poked(1e30)},
    st.tuples(st.sampled_from([NAN, INF, -INF, 1e30, -1e38]), PLACES).map(
        lambda one: (f"{one[0]} at {one[1]}", _poked(*one))
    ),
)
ARRAYS = {
    "number": d.Wrong({**OBJECT, "another": np.array(7), "text": np.array("x")}),
    "task": d.Wrong({**OBJECT, "another": np.array("juggle")}),
    "domain": d.Wrong({**OBJECT, "another": np.array("moon")}),
    "seed": d.Wrong(OBJECT),
    "state": NUMBERS,
    "action": NUMBERS,
    "success": COLUMN,
    "steps": COLUMN
    | {
        "beyond the rows": lambda array: array + 100,
        "negative": lambda array: array - 100,
        "the same twice": lambda array: np.full_like(array, 2),
        "not ascending": lambda array: array[::-1].copy(),
    },
    "pixels": COLUMN
    | {
        "of one channel": lambda array: array[:, :1],
        "of another size": lambda array: array[..., :-1],
        "as floats": lambda array: array / 255,
    },
}


def _many(data: bytes) -> bytes:
    """An archive of 20,000 arrays."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for number in range(20000):
            archive.writestr(f"{number}.npy", b"")
    return buffer.getvalue()


def _demos() -> Iterator[Target]:
    arrays = fields(ARRAYS) | {"an array more": lambda arrays: arrays.update(extra=np.zeros(3))}
    yield DEMOS.target("demo", d.SEALED.each(d.written) | d.PLACES, file=DEMO)
    yield DEMOS.target(
        "demo, checksum adapted", d.BYTES.but().each(signed), DEMOS.equal, file=DEMO
    )  # nobody reads its date
    yield DEMOS.target("demo's arrays", arrays.each(in_arrays), file=DEMO)
    hostile = {"with a pickle that runs code": lambda data: Bomb.npz("state"), "of 20,000 arrays": _many}
    hostile["that unpacks to a gigabyte"] = lambda data: npz_of_zeros(1 << 30)
    yield DEMOS.target("hostile demo", d.Wrong(hostile).each(signed), file=DEMO, within=4)
    yield DEMOS.one("no root", gone, "ur5")


ARGUMENTS = {
    "size": d.SIZE | {"larger": (500, 500), "fractions": (1.5, 2.5)},
    "split": d.Wrong({"unknown": "best"}),
    "validation_share": d.Wrong({"one": 1.0, "negative": -1.0}),
}
COLLECTION = {
    "demos": d.COUNT,
    "processes": d.COUNT.but("fraction"),
    "size": d.SIZE,
    "frames": d.COUNT_OR_NONE,
    "domain": d.Wrong({"unknown": "moon"}),
    "tasks": d.Wrong({"unknown": ["juggle"], "none": [], "twice": ["pick", "pick"]}),
    "seed": d.COUNT_OR_NONE,
    "max_steps": d.COUNT.but("fraction"),
    "noise": d.NOT_NEGATIVE,
}


def _collected(**given: Any) -> Any:
    return collect_ur5_demos("out", **{"demos": 1, "frames": None, "max_steps": 4, **given})


def targets() -> Iterator[Target]:
    """All of a folder of demos, and the arguments of what reads and makes it."""
    npz_of_zeros(1 << 30)  # here, not in each case's process
    yield from _manifest()
    yield from _demos()
    yield from targets_of(
        "ur5",
        DEMOS.arguments("UR5ExperienceReplay", wrong=ARGUMENTS),
        Subject(_collected, wrong=COLLECTION, name="collect_ur5_demos"),
    )
