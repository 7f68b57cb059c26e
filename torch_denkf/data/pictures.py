"""Images of one size: scaled when they are read, stored as uint8, returned as float32 in [0, 1]."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import IO

import cv2
import numpy as np
import torch
from torch import Tensor

from torch_denkf.deployment.files import clear_errors, reserve

__all__ = [
    "JoinedPictures",
    "check_size",
    "decode_picture",
    "float_pictures",
    "is_bomb",
    "image_store",
    "picture_files",
    "scaled",
    "text_of_size",
    "unnamed_file",
]


MOST_PIXELS = 10**8  # of one image
CURE = "pass cache=FOLDER, or cache=None for memory"


def check_size(size: Sequence[int]) -> tuple[int, int]:
    """Returns (height, width) as whole numbers.

    Raises:
        ValueError: unless they are two positive whole numbers.
    """
    whole = isinstance(size, Sequence) and all(hasattr(side, "__index__") for side in size)
    sides = [int(side) for side in size] if whole else []
    if len(sides) != 2 or min(sides) < 1:
        raise ValueError(f"size is (height, width) in pixels, whole numbers, and must be positive, got {size!r}")
    return sides[0], sides[1]


def text_of_size(size: Sequence[int]) -> str:
    """Returns a size (height, width) for a message."""
    return f"{size[1]} pixels wide and {size[0]} high"


def scaled(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Scales ``[H, W, 3]`` or grey ``[H, W]`` to ``[C, *size]``; shrinking averages over areas."""
    if image.shape[:2] != size:
        shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
        image = np.ascontiguousarray(image)
        image = cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.atleast_3d(image).transpose(2, 0, 1)


def decode_picture(data: bytes, flags: int = cv2.IMREAD_COLOR) -> np.ndarray | None:
    """Decodes a PNG, a JPEG or another file that OpenCV knows to RGB ``[H, W, 3]``; returns None if it is damaged.

    OpenCV's ``flags`` may select grey, ``[H, W]``.
    """
    # OpenCV would fill the rest of a truncated image, or complain on stderr: look for its end first.
    ends = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}
    complete = next((end in data[-64:] for begin, end in ends.items() if data.startswith(begin)), bool(data))
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if complete and not is_bomb(data) else None
    return pixels if pixels is None or pixels.ndim == 2 else pixels[..., ::-1]


def picture_files(folder: Path, suffixes: Collection[str]) -> list[Path]:
    """Returns the image files in a folder, unsorted, without hidden files of file managers, such as ._1.png.

    Raises:
        ValueError: if two files have the same stem, so that a frame would count twice, or one is neither file nor
            folder, such as a pipe, which would wait for a writer.
    """
    files: dict[str, Path] = {}
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in suffixes or file.name.startswith(".") or file.is_dir():
            continue
        if not file.is_file():
            raise ValueError(f"{file} is no file, but a pipe, a device or a link to nowhere; take it out of the folder")
        if (other := files.setdefault(file.stem, file)) is not file:
            raise ValueError(
                f"{file} and {other.name} are two images of one name, and their frame would count twice; take one of "
                "the two out of the folder"
            )
    return list(files.values())


def is_bomb(data: bytes) -> bool:
    r"""Returns True if a PNG's or a JPEG's header announces more than 10^8 pixels.

    Examples:
        >>> is_bomb(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + (30000).to_bytes(4) + (30000).to_bytes(4))
        True
    """
    height = width = 0
    if data.startswith(b"\x89PNG"):
        width, height = int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    at = 2 if data.startswith(b"\xff\xd8") else len(data)
    while at + 9 < len(data) and data[at] == 0xFF:  # JPEG: segments, of which a "start of frame" has the size
        if 0xC0 <= data[at + 1] <= 0xCF and data[at + 1] not in (0xC4, 0xC8, 0xCC):
            height, width = int.from_bytes(data[at + 5 : at + 7]), int.from_bytes(data[at + 7 : at + 9])
            break
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
    return height * width > MOST_PIXELS


def image_store(rows: int, size: tuple[int, int], folder: Path | None) -> np.ndarray:
    """Returns zeros, uint8 ``[rows, 3, H, W]``: in memory, or in a temporary file in ``folder``.

    Raises:
        OSError: if the folder cannot be written to, or has not enough space.
    """
    if folder is None:
        return np.zeros((rows, 3, *size), np.uint8)
    shape = (rows, 3, *size)
    name = f"{math.prod(shape) / 1e6:.1f} MB of pictures to {folder}"
    with unnamed_file(folder) as file, clear_errors(folder / "pictures", CURE, name=name):
        reserve(file, math.prod(shape))
        return np.memmap(file, np.uint8, "r+", shape=shape)


def unnamed_file(folder: Path) -> IO[bytes]:
    """Opens a file in ``folder`` that is deleted when it is closed.

    Raises:
        OSError: if the folder cannot be written to.
    """
    with clear_errors(folder / "file", CURE, name=f"to {folder}"):
        folder.mkdir(parents=True, exist_ok=True)
        return tempfile.TemporaryFile(dir=folder)


class JoinedPictures:
    """Concatenates images of several memory-mapped stores without copying them.

    Args:
        stores: uint8 ``[N_k, C, H, W]`` each.

    Examples:
        >>> joined = JoinedPictures([torch.zeros(2, 1, 1, 1), torch.ones(3, 1, 1, 1)])
        >>> joined.shape, joined[torch.tensor([4, 0])].flatten()
        (torch.Size([5, 1, 1, 1]), tensor([1., 0.]))
    """

    def __init__(self, stores: Sequence[Tensor]):
        self.stores = list(stores)
        lengths = torch.tensor([len(store) for store in self.stores], dtype=torch.int64)
        self._ends = lengths.cumsum(0)

    def __deepcopy__(self, memo: dict) -> JoinedPictures:
        # The images are read-only, and torch cannot copy memory-mapped ones.
        return self

    @property
    def shape(self) -> torch.Size:
        """Returns the shape of the concatenation."""
        return torch.Size([int(self._ends[-1]), *self.stores[0].shape[1:]])

    def __getitem__(self, index: Tensor) -> Tensor:
        """Returns images by index, int64 ``[m]``."""
        which = torch.searchsorted(self._ends, index, right=True)
        out = self.stores[0].new_empty(len(index), *self.stores[0].shape[1:])
        for number in which.unique().tolist():
            at, store = which == number, self.stores[number]
            out[at] = store[index[at] - int(self._ends[number]) + len(store)]
        return out


def float_pictures(pictures: Tensor | JoinedPictures, index: Tensor) -> dict[str, Tensor]:
    """Returns ``"pixels"`` of some images, float32 in [0, 1]; zeros for negative indices.

    Args:
        pictures: uint8 ``[N, C, H, W]``.
        index: int64 ``[m]``.

    Examples:
        >>> float_pictures(torch.full((2, 1, 1, 1), 255, dtype=torch.uint8), torch.tensor([1, -1]))["pixels"].flatten()
        tensor([1., 0.])
    """
    there = index >= 0
    if there.all():
        return {"pixels": pictures[index].float().div_(255)}
    pixels = torch.zeros(len(index), *pictures.shape[1:])
    pixels[there] = pictures[index[there]].float().div_(255)
    return {"pixels": pixels}
