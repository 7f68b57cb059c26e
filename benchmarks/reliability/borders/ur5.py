"""Demonstrations of the UR5 table."""

from __future__ import annotations

import hashlib
import io
import json
import warnings
import zipfile
from collections.abc import Callable, Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from tensordict import TensorDict

from benchmarks.reliability.case import Case, workshop
from benchmarks.reliability.damage import BYTES, copied, gone, same, written
from benchmarks.reliability.hostile import Bomb, npz_of_zeros
from tests.data.ur5.ur5_demos import make_demo, write_folder
from torch_denkf.data import UR5ExperienceReplay
from torch_denkf.envs.ur5.collect import collect_ur5_demos

ROWS = (6, 5, 7)
DEMO = "demo-000001.npz"
MANIFEST = "demos.jsonl"
Change = Callable[[Path], Any]


@cache
def sound() -> Path:
    """Three demos."""
    root = workshop() / "ur5"
    root.mkdir()
    return write_folder(root, [make_demo(number, rows) for number, rows in enumerate(ROWS)])


def read(root: Path, **options: Any) -> TensorDict:
    """All rows, as a user reads them."""
    return UR5ExperienceReplay(root, **{"split": "all", "cache": None, "progress": False, **options})[:]


@cache
def reference() -> TensorDict:
    """The rows without damage."""
    return read(sound())


def _act(change: Change, folder: Path, **options: Any) -> TensorDict:
    root = copied(sound(), folder)
    change(root)
    return read(root, **options)


def _equal(result: TensorDict) -> bool:
    return same(result, reference())


def _line(change: Callable[[dict], Any]) -> Change:
    """Changes a line of the manifest."""

    def act(root: Path) -> None:
        lines = [json.loads(line) for line in (root / MANIFEST).read_text().splitlines()]
        changed = change(lines[1])
        lines[1] = lines[1] if changed is None else changed
        (root / MANIFEST).write_text("\n".join(map(json.dumps, lines)) + "\n")

    return act


def _signed(root: Path, data: bytes) -> None:
    """Writes a demo with the manifest's checksum, as somebody with bad intentions would."""
    (root / DEMO).write_bytes(data)
    _line(lambda line: line.update(sha256=hashlib.sha256(data).hexdigest()))(root)


def _arrays(change: Callable[[dict[str, Any]], Any]) -> Change:
    """Changes the arrays of a demo, and its checksum."""

    def act(root: Path) -> None:
        with np.load(root / DEMO) as stored:
            arrays = dict(stored)
        change(arrays)
        buffer = io.BytesIO()
        np.savez_compressed(buffer, allow_pickle=True, **arrays)
        _signed(root, buffer.getvalue())

    return act


def _poke(name: str, value: float) -> Change:
    def change(arrays: dict[str, Any]) -> None:
        arrays[name] = arrays[name].copy()
        arrays[name][2, 3] = value

    return _arrays(change)


def _text(change: Callable[[str], str]) -> Change:
    return lambda root: (root / MANIFEST).write_text(change((root / MANIFEST).read_text()))


def _manifest() -> Iterator[Case]:
    for what, change in BYTES.items():
        act = partial(_warned, lambda root, change=change: written(root / MANIFEST, change))
        yield Case("ur5", f"manifest {what}", (MANIFEST,), act, _all_or_said)
    lines: dict[str, Callable[[dict], Any]] = {
        "a list": lambda line: [],
        "a number": lambda line: 3,
        "one field more": lambda line: line.update(colour="red"),
    }
    values: dict[str, dict[str, Any]] = {
        "demo": {"negative": -1, "text": "x", "another": 7, "nothing": None, "a fraction": 1.5},
        "file": {
            "outside": "../../../etc/passwd",
            "absolute": "/etc/passwd",
            "another demo": "demo-000000.npz",
            "empty": "",
            "a number": 3,
            "a device": "/dev/zero",
        },
        "sha256": {"empty": "", "another": "0" * 64, "a number": 3, "nothing": None},
        "rows": {
            "negative": -1,
            "zero": 0,
            "text": "x",
            "huge": 10**12,
            "a fraction": 5.5,
            "nothing": None,
            "one more": 6,
        },
        "frames": {"negative": -1, "text": "x", "huge": 10**12, "nothing": None, "one more": 4},
        "failures": {"negative": -1, "text": "x"},
    }
    for key, wrong in values.items():
        lines[f"without {key}"] = lambda line, key=key: line.pop(key) and None
        for what, value in wrong.items():
            lines[f"{key} {what}"] = lambda line, key=key, value=value: line.update({key: value})
    for what, change in lines.items():
        right = _equal if "failures" in what else None
        yield Case(
            "ur5", f"manifest's line: {what}", (MANIFEST, DEMO, "demo-000000.npz"), partial(_act, _line(change)), right
        )
    texts: dict[str, Callable[[str], str]] = {
        "a line that is no JSON in the middle": lambda text: text.replace("}\n", "}\nnothing\n", 1),
        "the last line cut": lambda text: text[: len(text) - 40],
        "a line twice": lambda text: text + text.splitlines()[1] + "\n",
        "an empty line in the middle": lambda text: text.replace("}\n", "}\n\n", 1),
    }
    for what, edit in texts.items():
        yield Case("ur5", f"manifest: {what}", (MANIFEST,), partial(_warned, _text(edit)), _all_or_said)


def _warned(change: Change, folder: Path) -> tuple[TensorDict, list[str]]:
    """The rows, and what was said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = _act(change, folder)
    return result, [str(warning.message) for warning in caught]


def _all_or_said(result: tuple[TensorDict, list[str]]) -> bool:
    """Right where all demos are there, or the first ones, and a warning names the list that lacks the others."""
    rows, said = result
    return _equal(rows) or (same(rows, reference()[: len(rows)]) and any(MANIFEST in message for message in said))


def _demos() -> Iterator[Case]:
    words = (DEMO,)
    for what, change in BYTES.items():
        yield Case(
            "ur5", f"demo {what}", words, partial(_act, lambda root, change=change: written(root / DEMO, change))
        )
        signed = lambda root, change=change: _signed(root, change((root / DEMO).read_bytes()))  # noqa: E731
        right = _equal  # a date in the archive, which nobody reads
        yield Case("ur5", f"demo {what}, checksum adapted", words, partial(_act, signed), right)
    arrays: dict[str, Callable[[dict[str, Any]], Any]] = {}
    for name in ("number", "task", "domain", "seed", "state", "action", "success", "steps", "pixels"):
        arrays[f"without {name}"] = lambda a, name=name: a.pop(name) is None
        arrays[f"{name} an object"] = lambda a, name=name: a.update({name: np.array([{}], dtype=object)})
        if name not in ("number", "task", "domain", "seed"):
            arrays[f"{name} a row less"] = lambda a, name=name: a.update({name: a[name][:-1]})
            arrays[f"{name} a scalar"] = lambda a, name=name: a.update({name: np.float32(3)})
            arrays[f"{name} text"] = lambda a, name=name: a.update({name: np.full(a[name].shape, "x")})
    arrays |= {
        "an array more": lambda a: a.update(extra=np.zeros(3)),
        "another task": lambda a: a.update(task=np.array("juggle")),
        "another domain": lambda a: a.update(domain=np.array("moon")),
        "another number": lambda a: a.update(number=np.array(7)),
        "a number of text": lambda a: a.update(number=np.array("x")),
        "steps beyond the rows": lambda a: a.update(steps=a["steps"] + 100),
        "steps negative": lambda a: a.update(steps=a["steps"] - 100),
        "the same step twice": lambda a: a.update(steps=np.full_like(a["steps"], 2)),
        "steps not ascending": lambda a: a.update(steps=a["steps"][::-1].copy()),
        "pixels of one channel": lambda a: a.update(pixels=a["pixels"][:, :1]),
        "pixels of another size": lambda a: a.update(pixels=a["pixels"][..., :-1]),
        "pixels as floats": lambda a: a.update(pixels=a["pixels"] / 255),
    }
    for what, edit in arrays.items():
        yield Case("ur5", f"demo's arrays: {what}", words, partial(_act, _arrays(edit)))
    for name in ("state", "action"):
        for value in (np.nan, np.inf, 1e30):
            yield Case("ur5", f"demo's {name} {value}", words, partial(_act, _poke(name, value)))
    yield Case("ur5", "demo taken away", words, partial(_act, lambda root: gone(root / DEMO)))
    yield Case("ur5", "demo a folder", words, partial(_act, lambda root: (gone(root / DEMO), (root / DEMO).mkdir())))
    yield Case(
        "ur5",
        "demo a link to a device",
        words,
        partial(_act, lambda root: (gone(root / DEMO), (root / DEMO).symlink_to("/dev/zero"))),
    )
    hostile = Bomb.npz("state")
    yield Case(
        "ur5", "demo with a pickle that runs code", words, partial(_act, lambda root: _signed(root, hostile)), within=2
    )
    bomb = npz_of_zeros(1 << 30)
    yield Case(
        "ur5", "demo that unpacks to a gigabyte", words, partial(_act, lambda root: _signed(root, bomb)), within=2
    )

    def many(root: Path) -> None:
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for number in range(20000):
                archive.writestr(f"{number}.npy", b"")
        _signed(root, buffer.getvalue())

    yield Case("ur5", "demo of 20,000 arrays", words, partial(_act, many), within=4)
    for what, change, also in (
        ("no root", gone, ("ur5",)),
        ("no manifest", lambda root: gone(root / MANIFEST), (MANIFEST,)),
    ):
        yield Case("ur5", what, also, partial(_act, change))


ARGUMENTS: dict[str, dict[str, Any]] = {
    "size": {
        "zero": (0, 4),
        "negative": (-4, 4),
        "one number": (4,),
        "text": "ab",
        "larger": (500, 500),
        "fractions": (1.5, 2.5),
    },
    "split": {"unknown": "best"},
    "validation_share": {"one": 1.0, "negative": -1.0},
}
COLLECTION: dict[str, dict[str, Any]] = {
    "demos": {"zero": 0, "negative": -1, "a fraction": 1.5, "text": "many"},
    "processes": {"zero": 0, "negative": -1, "text": "many"},
    "size": {"zero": (0, 4), "negative": (-4, 4), "one number": (4,), "text": "ab"},
    "frames": {"negative": -1, "text": "many", "a fraction": 1.5},
    "domain": {"unknown": "moon"},
    "tasks": {"unknown": ["juggle"], "none": [], "twice": ["pick", "pick"]},
    "seed": {"negative": -1, "text": "x", "a fraction": 1.5},
    "max_steps": {"zero": 0, "negative": -1, "text": "x"},
    "noise": {"negative": -1.0, "nan": float("nan"), "inf": float("inf"), "text": "x"},
}


def _arguments() -> Iterator[Case]:
    for name, values in ARGUMENTS.items():
        for what, value in values.items():
            yield Case(
                "ur5",
                f"UR5ExperienceReplay({name}: {what})",
                (name,),
                partial(_act, lambda root: None, **{name: value}),
            )
    for name, values in COLLECTION.items():
        for what, value in values.items():

            def act(folder: Path, name: str = name, value: Any = value) -> Any:
                return collect_ur5_demos(folder / "out", **{"demos": 1, "frames": None, "max_steps": 4, name: value})

            yield Case("ur5", f"collect_ur5_demos({name}: {what})", (name,), act)


def cases() -> Iterator[Case]:
    """All damaged demos."""
    sound()  # here, not in each case's process
    yield from _manifest()
    yield from _demos()
    yield from _arguments()
