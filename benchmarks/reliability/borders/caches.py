"""Entries of the cache that somebody changed."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import NonTensorData, TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.borders import kitti, lerobot, recordings, ur5
from benchmarks.reliability.damage import copied, gone, instead, same
from benchmarks.reliability.hostile import MARK, Bomb
from benchmarks.reliability.target import Target

#: What is kept, and how it is read with a cache.
READERS: dict[str, tuple[Callable[[], Path], Callable[..., TensorDict]]] = {
    "kitti": (kitti.sound, lambda root, cache: kitti.read(root, cache=cache)),
    "lerobot": (partial(lerobot.sound, 2), lambda root, cache: lerobot.read(root, cache=cache)),
    "ur5": (ur5.sound, lambda root, cache: ur5.read(root, cache=cache)),
    "recordings": (
        recordings.sound,
        lambda root, cache: recordings.read(root, camera="images", replay={"cache": cache}),
    ),
}


def _again(name: str, change: d.Change, folder: Path) -> tuple[TensorDict, TensorDict, list[str]]:
    """Returns what is read the first time, and again with a changed entry; and what is left half written."""
    sound, read = READERS[name]
    root, cache = copied(sound(), folder), folder / "cache"
    first = read(root, cache).clone()
    (entry,) = [path for path in cache.iterdir() if path.is_dir() and not path.name.startswith(".")]
    change(entry)
    second = read(root, cache).clone()
    return first, second, [path.name for path in cache.iterdir() if path.name.startswith(".writing")]


def _right(result: tuple[TensorDict, TensorDict, list[str]]) -> bool:
    first, second, left = result
    return not left and same(second, first)


def of_part(part: str, change: d.Change) -> d.Change:
    """Changes a file of an entry."""

    def act(entry: Path) -> None:
        paths = sorted(
            (path for path in entry.rglob("*") if path.is_file()), key=lambda path: (path.stat().st_size, path.name)
        )
        described = [path for path in paths if path.suffix == ".json"]
        tensors = [path for path in paths if path.suffix != ".json"]
        change({"largest": paths[-1], "smallest": tensors[0], "description": described[0]}[part])

    return act


def _planted(entry: Path) -> None:
    """An entry of tensordict's own format, with a pickle that runs code."""
    gone(entry)
    TensorDict({"image": torch.zeros(3), "evil": NonTensorData(Bomb())}, []).memmap(entry)
    shutil.rmtree(Path.cwd() / MARK, ignore_errors=True)


def _pickle_beside(entry: Path) -> None:
    for name in ("other.pickle", "_metadata.pkl", "entry.pkl"):
        (entry / name).write_bytes(Bomb.pickled())


def _pickle_inside(entry: Path) -> None:
    for file in entry.rglob("*"):
        if file.is_file() and file.suffix != ".json":
            file.write_bytes(Bomb.pickled())


def _half_written(entry: Path) -> None:
    """Leaves what a process that was killed leaves, with the lock of none."""
    left = entry.parent / ".writing-killed"
    left.mkdir()
    shutil.copytree(entry, left / "entry")
    (left / "lock").touch()
    gone(entry)


ENTRIES = d.Wrong(
    {
        "planted": _planted,
        "a pickle beside": _pickle_beside,
        "pickles as tensors": _pickle_inside,
        "emptied": lambda entry: [gone(path) for path in entry.iterdir()],
        "a file in its place": instead(Path.touch),
        "a link to nowhere in its place": instead(lambda entry: entry.symlink_to("nowhere")),
        "left half written by a killed process": _half_written,
        "a file more": lambda entry: (entry / "more").write_text("x"),
    }
)
NO_FOLDER = d.of("file/below", "/dev/null/below", 3)


def _nowhere(name: str, cache: Any, folder: Path) -> TensorDict:
    (folder / "file").touch()
    sound, read = READERS[name]
    return read(copied(sound(), folder), cache if isinstance(cache, int) else folder / cache)


def targets() -> Iterator[Target]:
    """All changed entries."""
    for name, (sound, _) in READERS.items():
        act, words = partial(_again, name), ("cache",)
        for part in ("largest", "smallest", "description"):
            wrong = (d.SEALED.each(d.written) | d.PLACES).each(partial(of_part, part))
            yield Target("caches", f"{name}, {part} file", words, act, wrong, _right, needs=sound)
        yield Target("caches", f"{name}, entry", words, act, ENTRIES, _right, needs=sound)
        yield Target("caches", f"{name}, cache", words, partial(_nowhere, name), NO_FOLDER, needs=sound)
