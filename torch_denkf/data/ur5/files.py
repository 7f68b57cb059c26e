"""One demonstration of the UR5 table a file, a list of checksums for all, and what is read back is what was written.

::

    root/collection.json     the options that all demos follow from
    root/demos.jsonl         a line a demo: its file, checksum, and what it holds
    root/demo-NNNNNN.npz     the demos
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import threading
import zipfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torch_denkf._files import clear_errors, write_bytes, write_text
from torch_denkf.simulation.ur5.names import TASKS

COLLECTION = "collection.json"
MANIFEST = "demos.jsonl"
COMMAND = "denkf collect-ur5"
MOST_BYTES = 1 << 32  # of one demo, unpacked: 350 pictures of 2,000 x 2,000
_HEADER = 1 << 14  # bytes in which an array's header is, at most


@dataclass
class Demo:
    """One successful episode, T steps of it, n of them with a picture.

    Attributes:
        number: of the demo in its collection.
        task: one of ``TASKS``.
        domain: one of ``DOMAIN_NAMES``.
        seed: of the environment, for this episode.
        state: float32 ``[T, 10]``, see :class:`torch_denkf.envs.UR5TableEnv`.
        action: float32 ``[T, 7]``: sent in that state; it leads to the next row's.
        success: bool ``[T]``: the task is done in that state.
        steps: int32 ``[n]``: rows that were drawn, ascending.
        pixels: uint8 ``[n, 3, H, W]``: of these rows.
    """

    number: int
    task: str
    domain: str
    seed: int
    state: np.ndarray
    action: np.ndarray
    success: np.ndarray
    steps: np.ndarray
    pixels: np.ndarray


@dataclass(frozen=True)
class Entry:
    """A demo's line in the manifest.

    Attributes:
        demo: its number.
        file: its name in the folder.
        sha256: of the file, in hexadecimal.
        rows: T.
        frames: n.
        failures: episodes that were drawn before this one and left out, since the expert failed.
    """

    demo: int
    file: str
    sha256: str
    rows: int
    frames: int
    failures: int = 0


def write_demo(root: Path, demo: Demo, failures: int = 0) -> Entry:
    """Write a demo beside its place and rename it, so that a file of that name is complete. Equal demos, equal bytes.

    Raises:
        OSError: if the file cannot be written, as on a full disk; names it and the free space.
    """
    name = f"demo-{demo.number:06d}.npz"
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **vars(demo))
    data = buffer.getvalue()
    write_bytes(root / name, data)
    return Entry(demo.number, name, hashlib.sha256(data).hexdigest(), len(demo.state), len(demo.steps), failures)


def what_is_wrong(root: Path, entry: Entry) -> str | None:
    """None for a file with the manifest's checksum, or else what is the matter, for a message."""
    try:
        data = (root / entry.file).read_bytes()
    except OSError as error:
        return f"{root / entry.file} cannot be read ({error.strerror})"
    return _compare(root, entry, data)


def _compare(root: Path, entry: Entry, data: bytes) -> str | None:
    if hashlib.sha256(data).hexdigest() == entry.sha256:
        return None
    return f"{root / entry.file} ({len(data)} bytes) does not have the checksum in {MANIFEST}: it was cut or changed"


_HEADERS = threading.Lock()


def _read_arrays(data: bytes, entry: Entry) -> dict[str, np.ndarray]:
    """The arrays of an npz file, by name; what it announces is compared with the manifest before it is unpacked.

    NumPy reads headers with ``ast.literal_eval``, which in Python 3.11 fails now and then where threads do it at a
    time ("AST constructor recursion depth mismatch", CPython issue 106905). So headers are read one after the other,
    and decompression, which takes the time, side by side.
    """
    arrays = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        _refuse_other_arrays(archive, entry)
        for member in archive.namelist():
            stream = io.BytesIO(archive.read(member))
            with _HEADERS:
                arrays[member.removesuffix(".npy")] = np.lib.format.read_array(stream, allow_pickle=False)
    return arrays


def _refuse_other_arrays(archive: zipfile.ZipFile, entry: Entry) -> None:
    """Looks at the headers alone: the rest could be of any size.

    Raises:
        ValueError: if an array is not what the manifest says.
    """
    expected: dict[str, tuple[int | None, ...]] = {"state": (entry.rows, 10), "action": (entry.rows, 7)}
    expected |= {"success": (entry.rows,), "steps": (entry.frames,), "pixels": (entry.frames, 3, None, None)}
    expected |= dict.fromkeys(("number", "task", "domain", "seed"), ())
    names = [member.filename.removesuffix(".npy") for member in archive.infolist()]
    if sorted(names) != sorted(expected):
        raise ValueError(f"it holds {sorted(names)}, expected {sorted(expected)}")
    total = sum(member.file_size for member in archive.infolist())
    if total > MOST_BYTES:
        raise ValueError(f"it announces {total} bytes, more than the {MOST_BYTES} that are unpacked")
    for member, name in zip(archive.infolist(), names, strict=True):
        with archive.open(member) as stream:
            head = io.BytesIO(stream.read(_HEADER))
        with _HEADERS:
            version = np.lib.format.read_magic(head)
            read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = read(head)
        fits = len(shape) == len(expected[name])
        fits = fits and all(want in (None, there) for want, there in zip(expected[name], shape, strict=True))
        if not fits or math.prod(shape) * dtype.itemsize != member.file_size - head.tell():
            raise _OtherShape(f"has {name!r} of shape {shape}, {MANIFEST} says {expected[name]}")


class _OtherShape(ValueError):
    """An array that is not what the manifest says."""


def read_demo(root: Path, entry: Entry) -> Demo:
    """Read a demo and compare it with its line in the manifest.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it was changed, or does not hold what the line says.
    """
    file = root / entry.file
    again = f"the collecting command ({COMMAND}), repeated, makes it again"
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise ValueError(f"{file} has {size} bytes, more than a demo can have ({MOST_BYTES}); {again}")
        data = file.read_bytes()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{file} is missing, but {MANIFEST} lists it; {again}") from error
    wrong = _compare(root, entry, data)
    if wrong is not None:
        raise ValueError(f"{wrong}; {again}")
    try:
        fields: dict[str, Any] = _read_arrays(data, entry)  # numbers and names are arrays without dimensions yet
        demo = Demo(**fields)
    except _OtherShape as error:
        raise ValueError(f"{file} {error}") from error
    except (TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{file} does not hold a demo ({error}); was it written by another version?") from error
    demo.number, demo.seed = int(demo.number), int(demo.seed)
    demo.task, demo.domain = str(demo.task), str(demo.domain)
    expected = {"state": (entry.rows, 10), "action": (entry.rows, 7), "success": (entry.rows,)}
    expected |= {"steps": (entry.frames,), "pixels": (entry.frames, 3, *demo.pixels.shape[2:])}
    for key, shape in expected.items():
        if getattr(demo, key).shape != shape:
            raise ValueError(f"{file} has {key!r} of shape {getattr(demo, key).shape}, {MANIFEST} says {shape}")
    if demo.task not in TASKS or demo.number != entry.demo:
        raise ValueError(f"{file} is demo {demo.number} of task {demo.task!r}, but is listed as demo {entry.demo}")
    return demo


def read_manifest(root: Path) -> dict[int, Entry]:
    """Entries by demo number, ascending; empty without a manifest. A line that a kill cut off counts as not written.

    Raises:
        OSError: if the manifest is there and cannot be read.
    """
    try:
        lines = (root / MANIFEST).read_text().splitlines()
    except FileNotFoundError:
        return {}
    entries = {}
    for line in lines:
        try:
            entry = Entry(**json.loads(line))
        except (TypeError, ValueError):
            continue
        entries[entry.demo] = entry
    return dict(sorted(entries.items()))


def write_manifest(root: Path, entries: Iterable[Entry]) -> None:
    """Write the whole manifest, in the demos' order, at once."""
    write_text(root / MANIFEST, "".join(map(_line, sorted(entries, key=lambda entry: entry.demo))))


def append_to_manifest(root: Path, entry: Entry) -> None:
    """Add a demo that was just written.

    Raises:
        OSError: if it cannot be added, as on a full disk; the manifest is then as it was.
    """
    file = root / MANIFEST
    with clear_errors(file):
        before = file.stat().st_size if file.exists() else 0
        try:
            with file.open("ab") as stream:
                stream.write(_line(entry).encode())
                stream.flush()
                os.fsync(stream.fileno())
        except OSError:
            if file.exists():
                os.truncate(file, before)
            raise


def write_options(root: Path, options: dict) -> None:
    """Write what all demos of the folder follow from."""
    write_text(root / COLLECTION, json.dumps(options, indent=1) + "\n")


def read_options(root: Path) -> dict | None:
    """What :func:`write_options` wrote, or None.

    Raises:
        ValueError: if the file is damaged.
    """
    try:
        return json.loads((root / COLLECTION).read_text())
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise ValueError(f"{root / COLLECTION} is damaged ({error}); collect into another folder") from error


def _line(entry: Entry) -> str:
    return json.dumps(asdict(entry)) + "\n"
