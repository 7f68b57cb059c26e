"""Cache entries of all kinds of recordings."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import NonTensorData, TensorDict

from benchmarks.reliability import damage as d
from benchmarks.reliability.damage import gone, instead, same
from benchmarks.reliability.hostile import MARK, Bomb
from benchmarks.reliability.target import Target
from tests.borders import kitti, lerobot, recordings, ur5

#: What is kept, and how it is read with a cache.
CACHED: dict[str, tuple[Callable[[], Path], Callable[[Path, Any], TensorDict]]] = {
    "kitti": (kitti.drives, lambda root, cache: kitti.read_drive(root, cache=cache)),
    "lerobot": (lerobot.V2.sound, lambda root, cache: lerobot.read_episodes(root, cache=cache)),
    "ur5": (ur5.demos, lambda root, cache: ur5.read_demos(root, cache=cache)),
    "recordings": (
        recordings.own,
        lambda root, cache: recordings.read_own(root, camera="images", replay={"cache": cache}),
    ),
}


def _again(name: str, change: d.Change, folder: Path) -> tuple[TensorDict, TensorDict, list[str]]:
    """Returns what is read the first time, and again with a changed entry; and what is left half written."""
    sound, read = CACHED[name]
    root, cache = d.copied(sound(), folder), folder / "cache"
    first = read(root, cache).clone()
    (entry,) = [path for path in cache.iterdir() if path.is_dir() and not path.name.startswith(".")]
    change(entry)
    return first, read(root, cache).clone(), [path.name for path in cache.glob(".writing*")]


def _as_before(result: tuple[TensorDict, TensorDict, list[str]]) -> bool:
    first, second, left = result
    return not left and same(second, first)


def _of_part(part: str, change: d.Change) -> d.Change:
    """Changes a file of an entry."""

    def act(entry: Path) -> None:
        files = sorted(filter(Path.is_file, entry.rglob("*")), key=lambda path: (path.stat().st_size, path.name))
        described = [path for path in files if path.suffix == ".json"]
        tensors = [path for path in files if path.suffix != ".json"]
        change({"largest": files[-1], "smallest": tensors[0], "description": described[0]}[part])

    return act


def _planted_entry(entry: Path) -> None:
    """An entry of tensordict's own format, with a pickle that runs code."""
    gone(entry)
    TensorDict({"image": torch.zeros(3), "evil": NonTensorData(Bomb())}, []).memmap(entry)
    shutil.rmtree(Path.cwd() / MARK, ignore_errors=True)


def _half_written(entry: Path) -> None:
    """Leaves what a process that was killed leaves, with the lock of none."""
    left = entry.parent / ".writing-killed"
    left.mkdir()
    entry.rename(left / "entry")
    (left / "lock").touch()


ENTRIES = {
    "planted": _planted_entry,
    "a pickle beside": lambda entry: [
        (entry / name).write_bytes(Bomb.pickled()) for name in ("other.pickle", "_metadata.pkl", "entry.pkl")
    ],
    "pickles as tensors": lambda entry: [
        file.write_bytes(Bomb.pickled()) for file in entry.rglob("*") if file.is_file() and file.suffix != ".json"
    ],
    "emptied": lambda entry: [gone(path) for path in entry.iterdir()],
    "a file in its place": instead(Path.touch),
    "a link to nowhere in its place": instead(lambda entry: entry.symlink_to("nowhere")),
    "left half written by a killed process": _half_written,
    "a file more": lambda entry: (entry / "more").write_text("x"),
}


def _nowhere(name: str, cache: Any, folder: Path) -> TensorDict:
    (folder / "file").touch()
    sound, read = CACHED[name]
    return read(d.copied(sound(), folder), cache if isinstance(cache, int) else folder / cache)


def targets() -> Iterator[Target]:
    """Yields damaged cache entries of each recording, and wrong cache folders."""
    for name, (sound, _) in CACHED.items():
        target = partial(Target, "caches", words=("cache",), needs=sound)
        for part in ("largest", "smallest", "description"):
            wrong = (d.SEALED | d.PLACES).each(partial(_of_part, part))
            yield target(f"{name}, {part} file", act=partial(_again, name), wrong=wrong, right=_as_before)
        yield target(f"{name}, entry", act=partial(_again, name), wrong=d.Wrong(ENTRIES), right=_as_before)
        nowhere = d.of("file/below", "/dev/null/below", 3)
        yield target(f"{name}, cache", act=partial(_nowhere, name), wrong=nowhere)
