"""Collections of UR5 demos, what reads them and what collects them."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import gone, put, same, spoiled, written
from benchmarks.reliability.documents import edited
from benchmarks.reliability.hostile import Bomb, archive, npz_of_zeros
from benchmarks.reliability.target import Source, Subject, Target, targets_of
from tests.applications.ur5.data.ur5_demos import make_demo, write_folder
from tests.borders.folders import ALL_ROWS, SIZES, made, one_row
from torch_denkf.applications.ur5 import UR5ExperienceReplay
from torch_denkf.applications.ur5.envs.collect import collect_ur5_demos

DEMO, MANIFEST = "demo-000001.npz", "demos.jsonl"


def read_demos(root: Path, **options: Any) -> TensorDict:
    """Returns all rows, as a user reads them."""
    return UR5ExperienceReplay(root, **{**ALL_ROWS, **options})[:]


def _warned(root: Path) -> tuple[TensorDict, list[str]]:
    """Returns the rows, and what was said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = read_demos(root)
    return result, [str(warning.message) for warning in caught]


demos = made("ur5", lambda root: write_folder(root, [make_demo(number, rows) for number, rows in enumerate((6, 5, 7))]))
DEMOS = Source("ur5", demos, read_demos)
LISTED = Source("ur5", demos, _warned)


def _all_or_said(result: tuple[TensorDict, list[str]]) -> bool:
    """Tells whether all demos are there, or the first ones, and a warning names the list that lacks the others."""
    rows, said = result
    first = same(rows, DEMOS.reference()[: len(rows)])
    return DEMOS.like()(rows) or (first and any(MANIFEST in message for message in said))


def signed(change: d.Change) -> d.Change:
    """Changes a demo, and the manifest's checksum, as somebody with bad intentions would."""

    def act(file: Path) -> None:
        change(file)
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
        edited(put((1, "sha256"), sha256))(file.with_name(MANIFEST))

    return act


TEXTS = {
    "a line twice": lambda lines: [*lines, lines[1]],
    "one field more": put(1, lambda line: {**line, "colour": "red"}),
    "another demo": put((1, "demo"), 7),
    "another demo's file": put((1, "file"), "demo-000000.npz"),
    "one row more": put((1, "rows"), 6),
    "one frame more": put((1, "frames"), 4),
    "no checksum of this": put((1, "sha256"), "0" * 64),
}
ARRAYS = {
    "task juggle": put("task", np.array("juggle")),
    "domain moon": put("domain", np.array("moon")),
    "number 7": put("number", np.array(7)),
    "state 1e30": put("state", spoiled(0.5, 1e30)),
    "pixels as floats": put("pixels", lambda array: array / 255),
    "an array more": lambda arrays: {**arrays, "extra": np.zeros(3)},
    "steps beyond the rows": put("steps", lambda array: array + 100),
    "steps negative": put("steps", lambda array: array - 100),
    "steps the same twice": put("steps", lambda array: np.full_like(array, 2)),
    "steps not ascending": put("steps", lambda array: array[::-1].copy()),
}


def _files() -> Iterator[Target]:
    npz_of_zeros(1 << 30)  # here, not in each case's process
    words, lost = (MANIFEST, DEMO, "demo-000000.npz", "demo-000002.npz"), lambda place: place[-1] == "failures"
    yield LISTED.target("manifest", d.FILE, _all_or_said, file=MANIFEST)
    yield from DEMOS.document(MANIFEST, DEMOS.like(), words, skip=one_row, loose=lost)
    lines = d.Wrong(TEXTS).each(edited)
    yield DEMOS.target("manifest's lines", lines, None, words, MANIFEST, rights={"a line twice": DEMOS.like()})
    yield DEMOS.target("demo", d.SEALED | d.PLACES, file=DEMO)
    dated = d.BYTES.but().each(signed)  # nobody reads the date of an archive
    yield DEMOS.target("demo, checksum adapted", dated, DEMOS.like(), file=DEMO)
    yield from DEMOS.document(DEMO, then=signed)
    yield DEMOS.target("demo's arrays", d.Wrong(ARRAYS).each(edited).each(signed), file=DEMO)
    hostile = {
        "with a pickle that runs code": written(lambda data: Bomb.npz("state")),
        "of 20,000 arrays": archive({f"{number}.npy": b"" for number in range(20000)}),
        "that unpacks to a gigabyte": written(lambda data: npz_of_zeros(1 << 30)),
    }
    yield DEMOS.target("hostile demo", d.Wrong(hostile).each(signed), file=DEMO, within=4)
    yield DEMOS.target("no root", gone, None, "ur5")


# -------------------------------------------------------------------------------------------------------- arguments


def _arguments() -> Iterator[Subject]:
    replay = {"size": SIZES | {"larger": (500, 500)}, "split": d.of("best"), "validation_share": d.of(1.0, -1.0)}
    collected = {
        "demos": d.COUNT,
        **dict.fromkeys(("processes", "max_steps"), d.COUNT.but("fraction")),
        **dict.fromkeys(("frames", "seed"), d.COUNT_OR_NONE),
        "size": d.SIZE,
        "domain": d.of("moon"),
        "tasks": d.of(["juggle"], [], ["pick", "pick"]),
        "noise": d.NOT_NEGATIVE,
    }
    one = {"demos": 1, "frames": None, "max_steps": 4}
    yield DEMOS.arguments("UR5ExperienceReplay", wrong=replay)
    collect = lambda **given: collect_ur5_demos("out", **{**one, **given})  # noqa: E731
    yield Subject(collect, wrong=collected, name="collect_ur5_demos")


def targets() -> Iterator[Target]:
    """Yields all files and arguments."""
    yield from _files()
    yield from targets_of("ur5", *_arguments())
