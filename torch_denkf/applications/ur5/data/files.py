"""Files of UR5 demonstrations, one each, and a manifest with checksums.

::

    root/collection.json     the options of the collection
    root/demos.jsonl         a line per demo: file, checksum and sizes
    root/demo-NNNNNN.npz     the demos
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import threading
import warnings
import zipfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torch_denkf._checks import check_count
from torch_denkf.applications.ur5.simulation.names import DOMAIN_NAMES, TASKS
from torch_denkf.data.text import read_lines
from torch_denkf.deployment.files import clear_errors, write_bytes, write_text

COLLECTION = "collection.json"
MANIFEST = "demos.jsonl"
PATTERN = "demo-*.npz"
COMMAND = "denkf collect-ur5"
MOST_BYTES = 1 << 32  # of one demo, unpacked: 350 pictures of 2,000 x 2,000
_MOST_ROWS = 10**6  # of one demo
_LARGEST = 1e6  # rad or m, of a state or an action
#: Of the arrays in a demo's file.
_KINDS = {"number": "iu", "task": "U", "domain": "U", "seed": "iu", "success": "b", "steps": "iu", "pixels": "u"}
_HEADER = 1 << 14  # bytes in which an array's header is, at most
AGAIN = f"the collecting command ({COMMAND}), repeated, makes it again"


@dataclass
class Demo:
    """A successful episode of T steps, n of them with an image.

    Attributes:
        number: of the demo in its collection.
        task: one of ``TASKS``.
        domain: one of ``DOMAIN_NAMES``.
        seed: of the environment, for this episode.
        state: float32 ``[T, 10]``, see :class:`torch_denkf.applications.ur5.UR5TableEnv`.
        action: float32 ``[T, 7]``: sent in that state; it leads to the next one.
        success: bool ``[T]``: the task is done in that state.
        steps: int32 ``[n]``: rendered rows, ascending.
        pixels: uint8 ``[n, 3, H, W]``: images of these rows.
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
        failures: number of failed episodes of the expert before this one, which were dropped.
    """

    demo: int
    file: str
    sha256: str
    rows: int
    frames: int
    failures: int = 0


def write_demo(root: Path, demo: Demo, failures: int = 0) -> Entry:
    """Writes a demo atomically. The bytes depend on the demo only.

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
    """Returns None for a file with the manifest's checksum, or else a message about the difference."""
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
    """Reads the arrays of an npz file by name, after a check of the headers.

    NumPy reads headers with ``ast.literal_eval``, which in Python 3.11 sometimes fails in concurrent threads ("AST
    constructor recursion depth mismatch", CPython issue 106905). So headers are read sequentially, and decompression,
    the slow part, is parallel.
    """
    arrays = {}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        _check_arrays(archive, entry)
        for member in archive.namelist():
            stream = io.BytesIO(archive.read(member))
            with _HEADERS:
                arrays[member.removesuffix(".npy")] = np.lib.format.read_array(stream, allow_pickle=False)
    return arrays


def _check_arrays(archive: zipfile.ZipFile, entry: Entry) -> None:
    """Checks the headers only, before arrays of unknown size are unpacked.

    Raises:
        ValueError: if an array differs from the manifest.
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
    """Raised for an array that differs from the manifest."""


def read_demo(root: Path, entry: Entry) -> Demo:
    """Reads a demo and compares it with its line in the manifest.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it was changed, differs from the line, or has values that are not finite.
    """
    file = root / entry.file
    if (file.is_symlink() or file.exists()) and not file.is_file():
        raise ValueError(f"{file} is no file; {AGAIN}")
    try:
        size = file.stat().st_size
        if size > MOST_BYTES:
            raise ValueError(f"{file} has {size} bytes, more than a demo can have ({MOST_BYTES}); {AGAIN}")
        data = file.read_bytes()
    except FileNotFoundError as error:
        raise FileNotFoundError(f"{file} is missing, but {MANIFEST} lists it; {AGAIN}") from error
    wrong = _compare(root, entry, data)
    if wrong is not None:
        raise ValueError(f"{wrong}; {AGAIN}")
    try:
        fields: dict[str, Any] = _read_arrays(data, entry)  # numbers and names are arrays without dimensions yet
        demo = Demo(**fields)
    except _OtherShape as error:
        raise ValueError(f"{file} {error}") from error
    except (TypeError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(f"{file} does not hold a demo ({error}); was it written by another version?") from error
    for key, kind in _KINDS.items():
        if getattr(demo, key).dtype.kind not in kind:
            raise ValueError(f"{file} has {key!r} of {getattr(demo, key).dtype}, not of a demo's kind; {AGAIN}")
    demo.number, demo.seed = int(demo.number), int(demo.seed)
    demo.task, demo.domain = str(demo.task), str(demo.domain)
    for key in ("state", "action"):
        values = getattr(demo, key)
        if not np.issubdtype(values.dtype, np.floating) or not (np.abs(values) <= _LARGEST).all():
            row = 0 if values.dtype.kind != "f" else int(np.flatnonzero(~(np.abs(values) <= _LARGEST).all(-1))[0])
            raise ValueError(
                f"{file} has {key!r} {values[row].tolist()} in row {row}, expected finite numbers, rad and m; {AGAIN}"
            )
    steps = demo.steps
    if len(steps) and (steps.min() < 0 or steps.max() >= entry.rows or (np.diff(steps) <= 0).any()):
        raise ValueError(f"{file} has 'steps' {steps.tolist()[:9]}, expected ascending rows of {entry.rows}; {AGAIN}")
    if demo.domain not in DOMAIN_NAMES:
        raise ValueError(f"{file} is of the unknown domain {demo.domain!r}; there are {', '.join(DOMAIN_NAMES)}")
    if demo.task not in TASKS or demo.number != entry.demo:
        raise ValueError(f"{file} is demo {demo.number} of task {demo.task!r}, but is listed as demo {entry.demo}")
    return demo


def read_manifest(root: Path, *, skip_damaged: bool = False) -> dict[int, Entry]:
    """Returns entries by demo number, ascending; empty without a manifest. A truncated last line is skipped.

    Args:
        root: folder of the demos.
        skip_damaged: True skips damaged lines with a warning, for a caller that records their demos again.

    Raises:
        OSError: if the manifest exists and cannot be read.
        ValueError: if a line is damaged or a demo is repeated, with the line.
    """
    file = root / MANIFEST
    if not file.exists():
        return {}
    if not file.is_file():  # a pipe would wait for a writer
        raise ValueError(f"{file} is no file; {AGAIN}")
    lines = read_lines(file)
    cut = bool(lines) and not file.read_bytes().endswith(b"\n")
    entries: dict[int, Entry] = {}
    for number, line in enumerate(lines, start=1):
        try:
            entry = _entry(line)
            if entries.get(entry.demo, entry) != entry:
                raise ValueError(f"demo {entry.demo} is listed in another line, too")
        except (TypeError, ValueError) as error:
            if cut and number == len(lines):
                warnings.warn(
                    f"{file}:{number} was cut off, by a kill perhaps; its demo counts as not written", stacklevel=3
                )
                continue
            wrong = f"{file}:{number} is damaged ({error}): {line[:80]!r}"
            if not skip_damaged:
                raise ValueError(
                    f"{wrong}; the collecting command ({COMMAND}), repeated, makes its demo again"
                ) from error
            warnings.warn(f"{wrong}; its demo is made again", stacklevel=3)
            continue
        entries[entry.demo] = entry
    return dict(sorted(entries.items()))


def _entry(line: str) -> Entry:
    fields = json.loads(line)
    if not isinstance(fields, dict):
        raise ValueError("no entry of a demo")
    entry = Entry(**fields)
    for name, least in (("demo", 0), ("rows", 1), ("frames", 0), ("failures", 0)):
        check_count(name, getattr(entry, name), least=least)
    if entry.rows > _MOST_ROWS or entry.frames > entry.rows:
        raise ValueError(f"a demo has up to {_MOST_ROWS} rows, and no more frames; got {entry.rows} and {entry.frames}")
    name = entry.file
    if not isinstance(name, str) or name in ("", "..") or Path(name).name != name or "\0" in name:
        raise ValueError(f"it names a file outside of its folder, {entry.file!r}; such a list may read all of yours")
    if not isinstance(entry.sha256, str):
        raise ValueError(f"sha256 is a checksum in hexadecimal; got {entry.sha256!r}")
    return entry


def write_manifest(root: Path, entries: Iterable[Entry]) -> None:
    """Writes the manifest atomically, in the order of the demos."""
    write_text(root / MANIFEST, "".join(map(_line, sorted(entries, key=lambda entry: entry.demo))))


def append_to_manifest(root: Path, entry: Entry) -> None:
    """Appends a demo.

    Raises:
        OSError: if it cannot be appended, as on a full disk; the manifest is then unchanged.
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
    """Writes the options of the collection."""
    write_text(root / COLLECTION, json.dumps(options, indent=1) + "\n")


def read_options(root: Path) -> dict | None:
    """Reads the result of :func:`write_options`, or returns None.

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
