"""One entry of the cache: tensors as files, and a manifest with their dtypes, shapes and checksums.

::

    ENTRY/manifest.json      format, batch sizes, and of each tensor: dtype, shape, bytes, checksums, time of writing
    ENTRY/NAME.bin           a tensor's bytes in C order, little endian; NAME is its key, nested ones joined by dots

No other file is read, and no file can contain code.
"""

from __future__ import annotations

import contextlib
import errno
import json
import mmap
import os
import sys
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import torch
from tensordict import TensorDict, is_leaf_nontensor
from torch import Tensor

from torch_denkf.deployment.files import reserve, sync, write_text

__all__ = [
    "MANIFEST",
    "CachedTensor",
    "DamagedEntry",
    "check_entry",
    "is_entry",
    "open_entry",
    "seal_entry",
    "write_entry",
]

MANIFEST = "manifest.json"
FORMAT = "torch_denkf.cache/1"
END = 1 << 16  # bytes at either end of a file that are compared when it is opened
_BLOCK = 1 << 24  # bytes that are written or added to a checksum at a time
_LARGEST_MANIFEST = 1 << 20
_DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (torch.bool, torch.uint8, torch.int32, torch.int64, torch.float16, torch.float32, torch.float64)
}
#: Files whose whole checksum this process has compared, with their time of writing.
_COMPARED: dict[str, int] = {}
_MAP = mmap.MAP_PRIVATE | getattr(mmap, "MAP_NORESERVE", 0x4000 if sys.platform == "linux" else 0)


class DamagedEntry(Exception):
    """Raised for a damaged entry; says what is wrong with it."""


class CachedTensor(Tensor):
    """A file of the cache as a tensor: writing to it changes a copy in this process, never the file.

    Pickles contain the name of the file, not its content, also those of a view, such as a slice. Results of
    computations are plain tensors.
    """

    file: Path

    @classmethod
    def open(cls, file: Path, dtype: torch.dtype, shape: Sequence[int], *view: Any) -> CachedTensor:
        """Maps a file that holds a tensor; ``view`` is the shape, the strides and the offset of a part of it.

        Raises:
            OSError: if the size of the file differs from the tensor's.
        """
        whole = _map(file, dtype, torch.Size(shape))
        out = (whole.as_strided(*view) if view else whole).as_subclass(cls)
        out.file = file
        return out

    @classmethod
    def __torch_function__(cls, func, types, args=(), kwargs=None):
        out = Tensor.__torch_function__(func, (), args, kwargs)  # plain tensors
        if type(out) is Tensor and args and isinstance(args[0], cls) and _place(out) == _place(args[0]):
            out = out.as_subclass(cls)
            out.file = args[0].file
        return out

    def __reduce_ex__(self, protocol):
        if self._version:  # it was written to, and differs from the file
            return self.clone().__reduce_ex__(protocol)
        whole = (self.untyped_storage().nbytes() // self.itemsize,)
        return self.open, (self.file, self.dtype, whole, self.shape, self.stride(), self.storage_offset())


def write_entry(folder: Path, content: TensorDict) -> None:
    """Writes tensors that are in memory as an entry.

    Raises:
        OSError: if there is not enough space.
    """
    folder.mkdir()
    for name, tensor in _tensors(content):
        file = folder / f"{'.'.join(name)}.bin"
        with file.open("wb", buffering=0) as stream:
            data = _bytes(tensor).numpy().data
            reserve(stream, len(data))
            for begin in range(0, len(data), _BLOCK):
                part = data[begin : begin + _BLOCK]
                while len(part):
                    part = part[stream.write(part) :]
    seal_entry(folder, content)


def seal_entry(folder: Path, content: TensorDict) -> None:
    """Computes the checksums of an entry's files, writes its manifest, and waits until all is on the disk."""
    tensors = {}
    for name, tensor in _tensors(content):
        file = folder / f"{'.'.join(name)}.bin"
        sync(file)
        with file.open("rb") as stream:
            sums = {"crc32": _whole(stream), "ends": _ends(stream), "written": os.fstat(stream.fileno()).st_mtime_ns}
        shape = {"dtype": str(tensor.dtype).removeprefix("torch."), "shape": list(tensor.shape)}
        tensors[".".join(name)] = {**shape, "bytes": file.stat().st_size, **sums}
    sizes = {".".join(name): list(size) for name, size in _batch_sizes(content)}
    _write_manifest(folder, {"format": FORMAT, "batch_sizes": sizes, "tensors": tensors})


def _write_manifest(folder: Path, content: dict[str, Any]) -> None:
    text = json.dumps(content)
    write_text(folder / MANIFEST, json.dumps({"crc32": zlib.crc32(text.encode()), "content": text}))


def open_entry(folder: Path) -> TensorDict:
    """Maps the tensors of an entry, after a check of each file's size, time of writing, and both ends.

    A file with a later time of writing than in the manifest is compared once with its whole checksum; if it is valid,
    as after a copy, the manifest gets the new time.

    Raises:
        DamagedEntry: if something is wrong; says what.
        FileNotFoundError: without the entry.
    """
    content = _read_manifest(folder)
    try:
        out, renewed = TensorDict({}, content["batch_sizes"][""], device="cpu"), False
        for name, about in content["tensors"].items():
            file = folder / f"{name}.bin"
            written = _check(file, about, whole=False)
            if written != about.get("written"):
                about["written"], renewed = written, True
            out.set(tuple(name.split(".")), CachedTensor.open(file, _DTYPES[about["dtype"]], about["shape"]))
        for name, size in content["batch_sizes"].items():
            if name:
                out.get(tuple(name.split("."))).batch_size = size
    except (KeyError, TypeError, ValueError, RuntimeError, OSError) as error:
        raise DamagedEntry(f"{folder / MANIFEST} does not fit its files ({error})") from error
    if renewed:
        with contextlib.suppress(OSError):  # in a read-only cache the next process compares again
            _write_manifest(folder, content)
    return out.lock_()


def check_entry(folder: Path) -> None:
    """Compares every byte of an entry with its checksums.

    Raises:
        DamagedEntry: if something is wrong; says what.
        FileNotFoundError: without the entry.
    """
    for name, about in _read_manifest(folder)["tensors"].items():
        _check(folder / f"{name}.bin", about, whole=True)


def is_entry(folder: Path) -> bool:
    """Returns True for a folder in the format of this module, valid or not."""
    try:
        with _open(folder / MANIFEST) as stream:
            return FORMAT.encode() in stream.read(_LARGEST_MANIFEST)
    except OSError:
        return False


def _open(file: Path) -> BinaryIO:
    """Opens a plain file; a pipe would wait for a writer."""
    if file.exists() and not file.is_file():
        raise OSError(errno.EINVAL, "it is no file", str(file))
    return file.open("rb")


def _read_manifest(folder: Path) -> dict[str, Any]:
    file = folder / MANIFEST
    try:
        with _open(file) as stream:
            sealed = json.loads(stream.read(_LARGEST_MANIFEST))
        text = sealed["content"]
        content = json.loads(text)
        sound = zlib.crc32(text.encode()) == sealed["crc32"] and content["format"] == FORMAT
    except (FileNotFoundError, NotADirectoryError):
        if folder.is_dir():
            raise DamagedEntry(f"it has no {MANIFEST}: another version wrote it, or a part was deleted") from None
        raise FileNotFoundError(f"no entry {folder}") from None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DamagedEntry(f"{file} cannot be read ({error})") from error
    if not sound:
        raise DamagedEntry(f"{file} does not have its checksum")
    for name in content["tensors"]:
        if "/" in name or "\0" in name:
            raise DamagedEntry(f"{file} names a file outside: {name!r}")
    return content


def _check(file: Path, about: dict[str, Any], whole: bool) -> int:
    """Compares a file with its entry in the manifest, and returns its time of writing, ns."""
    try:
        with _open(file) as stream:
            size = os.fstat(stream.fileno()).st_size
            expected = torch.Size(about["shape"]).numel() * _DTYPES[about["dtype"]].itemsize
            if not size == about["bytes"] == expected:
                raise DamagedEntry(f"{file} has {size} bytes instead of {expected}")
            written = os.fstat(stream.fileno()).st_mtime_ns
            whole = whole or written not in (about.get("written"), _COMPARED.get(str(file)))
            if _ends(stream) != about["ends"] or (whole and _whole(stream) != about["crc32"]):
                raise DamagedEntry(f"{file} does not have its checksum")
            if whole:
                _COMPARED[str(file)] = written
            return written
    except OSError as error:
        raise DamagedEntry(f"{file} cannot be read ({error.strerror})") from error


def _whole(stream: BinaryIO) -> int:
    stream.seek(0)
    total = 0
    while block := stream.read(_BLOCK):
        total = zlib.crc32(block, total)
    return total


def _ends(stream: BinaryIO) -> int:
    """Returns the CRC-32 of both ends of a file, or of all of a small one."""
    size = os.fstat(stream.fileno()).st_size
    stream.seek(0)
    total = zlib.crc32(stream.read(END))
    if size > END:
        stream.seek(max(END, size - END))
        total = zlib.crc32(stream.read(END), total)
    return total


def _map(file: Path, dtype: torch.dtype, shape: torch.Size) -> Tensor:
    size = shape.numel() * dtype.itemsize
    with file.open("rb") as stream:
        there = os.fstat(stream.fileno()).st_size
        if there != size:
            raise OSError(f"{file} has {there} bytes instead of {size}; delete its folder, and it is made again")
        if not size:
            return torch.empty(shape, dtype=dtype)
        mapped = mmap.mmap(stream.fileno(), size, _MAP, mmap.PROT_READ | mmap.PROT_WRITE)
    return torch.frombuffer(mapped, dtype=dtype).reshape(shape)


def _bytes(tensor: Tensor) -> Tensor:
    return tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8)


def _tensors(content: TensorDict) -> Iterator[tuple[tuple[str, ...], Tensor]]:
    for key in content.keys(include_nested=True, leaves_only=True, is_leaf=is_leaf_nontensor):
        name = (key,) if isinstance(key, str) else key
        value = content.get(key)
        dtype = str(getattr(value, "dtype", type(value).__name__)).removeprefix("torch.")
        if dtype not in _DTYPES or not isinstance(value, Tensor) or any("." in part or "/" in part for part in name):
            raise TypeError(f"the cache holds tensors alone, of {', '.join(_DTYPES)}; {key!r} is {dtype}")
        yield name, value


def _batch_sizes(content: TensorDict) -> Iterator[tuple[tuple[str, ...], torch.Size]]:
    yield (), content.batch_size
    for key in content.keys(include_nested=True):
        value = content.get(key)
        if isinstance(value, TensorDict):
            yield (key,) if isinstance(key, str) else key, value.batch_size


def _place(tensor: Tensor) -> int:
    """Returns the address of the memory that a tensor is a view of."""
    return tensor.untyped_storage().data_ptr()
