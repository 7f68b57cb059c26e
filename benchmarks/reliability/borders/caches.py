"""Entries of the cache that somebody changed."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import NonTensorData, TensorDict

from benchmarks.reliability.borders import kitti, lerobot, recordings, ur5
from benchmarks.reliability.case import Case
from benchmarks.reliability.damage import BYTES, copied, gone, same, written
from benchmarks.reliability.hostile import MARK, Bomb, ran

READERS: dict[str, tuple[Callable[[], Path], Callable[..., TensorDict]]] = {
    "kitti": (kitti.sound, kitti.read),
    "lerobot": (partial(lerobot.sound, 2), lerobot.read),
    "ur5": (ur5.sound, ur5.read),
    "recordings": (recordings.sound, partial(recordings.read, camera="images")),
}
PARTS = ("largest", "smallest", "description")


def _read(name: str, root: Path, cache: Any) -> TensorDict:
    read = READERS[name][1]
    if name == "recordings":
        return read(root, replay={"cache": cache})
    return read(root, cache=cache)


def _again(name: str, change: Callable[[Path], Any], folder: Path) -> tuple[TensorDict, TensorDict, bool, list[str]]:
    """What is read the first time, and again with a changed entry; whether code ran, and what is left half written."""
    root, cache = copied(READERS[name][0](), folder), folder / "cache"
    first = _read(name, root, cache).clone()
    (entry,) = [path for path in cache.iterdir() if path.is_dir() and not path.name.startswith(".")]
    change(entry)
    second = _read(name, root, cache).clone()
    return first, second, ran(folder), [path.name for path in cache.iterdir() if path.name.startswith(".writing")]


def _right(result: tuple[TensorDict, TensorDict, bool, list[str]]) -> bool:
    first, second, code_ran, left = result
    return not code_ran and not left and same(second, first)


def _file(entry: Path, part: str) -> Path:
    files = sorted(
        (path for path in entry.rglob("*") if path.is_file()), key=lambda path: (path.stat().st_size, path.name)
    )
    if part == "description":
        return next(path for path in files if path.suffix == ".json")
    return files[-1] if part == "largest" else next(path for path in files if path.suffix != ".json")


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
    """What a process that was killed leaves, with the lock of none."""
    left = entry.parent / ".writing-killed"
    left.mkdir()
    shutil.copytree(entry, left / "entry")
    (left / "lock").touch()
    gone(entry)


CHANGES: dict[str, Callable[[Path], Any]] = {
    "planted": _planted,
    "a pickle beside": _pickle_beside,
    "pickles as tensors": _pickle_inside,
    "emptied": lambda entry: [gone(path) for path in entry.iterdir()],
    "a file in its place": lambda entry: (gone(entry), entry.write_text("")),
    "a link to nowhere in its place": lambda entry: (gone(entry), entry.symlink_to("nowhere")),
    "left half written by a killed process": _half_written,
    "a file more": lambda entry: (entry / "more").write_text("x"),
}


def cases() -> Iterator[Case]:
    """All changed entries."""
    for make, _ in READERS.values():
        make()  # here, not in each case's process
    for name in READERS:
        for part in PARTS:
            for what, change in BYTES.items():
                act = partial(_again, name, lambda entry, part=part, change=change: written(_file(entry, part), change))
                yield Case("caches", f"{name}: {part} file {what}", ("cache",), act, _right)
            act = partial(_again, name, lambda entry, part=part: gone(_file(entry, part)))
            yield Case("caches", f"{name}: {part} file taken away", ("cache",), act, _right)
        for what, change in CHANGES.items():
            yield Case("caches", f"{name}: an entry {what}", ("cache",), partial(_again, name, change), _right)
        for what, cache in {"in a file": "file/below", "in a device": "/dev/null/below", "a number": 3}.items():

            def act(folder: Path, name: str = name, cache: Any = cache) -> Any:
                (folder / "file").write_text("")
                place = cache if isinstance(cache, int) or cache.startswith("/") else folder / cache
                return _read(name, copied(READERS[name][0](), folder), place)

            yield Case("caches", f"{name}: cache {what}", ("cache",), act)
