"""Cameras that fail, with and without saying so: frames that do not arrive, are black, or are hidden in part."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.envs import OccludingBox

__all__ = ["CameraFailure", "fail_frames"]


class CameraFailure(NamedTuple):
    """Failure of the camera over a stretch of frames.

    Attributes:
        kind: ``"missing"`` (the frames do not arrive, and that is known), ``"black"`` (they arrive, black) or
            ``"box"`` (:class:`torch_denkf.envs.OccludingBox`: something hides a part of each picture).
        first: number of the first frame.
        last: number of the last frame.
    """

    kind: Literal["missing", "black", "box"]
    first: int
    last: int

    @property
    def announced(self) -> bool:
        """Returns True if the camera itself reports the failure."""
        return self.kind == "missing"


def fail_frames(frames: Iterable[np.ndarray | None], failures: Sequence[CameraFailure]) -> Iterator[np.ndarray | None]:
    """Yields the frames of a camera that fails.

    Args:
        frames: images ``[H, W]`` or ``[H, W, 3]``, uint8; ``None`` for one that is missing.
        failures: what happens when; of two at a time the first.

    Yields:
        The images; ``None`` where one is missing. Those that are changed are copies.

    Raises:
        ValueError: for a kind of failure that is not known.

    Example:
        >>> failures = [CameraFailure("missing", 1, 1), CameraFailure("black", 2, 3)]
        >>> frames = fail_frames((np.full((4, 6), 9, np.uint8) for _ in range(5)), failures)
        >>> [None if frame is None else int(frame.max()) for frame in frames]
        [9, None, 0, 0, 9]
    """
    if unknown := [failure.kind for failure in failures if failure.kind not in ("missing", "black", "box")]:
        raise ValueError(f"a camera fails in the ways 'missing', 'black' and 'box'; got {unknown}")
    box = OccludingBox()
    for number, frame in enumerate(frames):
        failure = next((each for each in failures if each.first <= number <= each.last), None)
        if failure is None or frame is None:
            yield frame
        elif failure.kind == "missing":
            yield None
        elif failure.kind == "black":
            yield np.zeros_like(frame)
        else:
            yield _covered(frame, box)


def _covered(frame: np.ndarray, box: OccludingBox) -> np.ndarray:
    picture = torch.from_numpy(np.ascontiguousarray(frame).reshape(*frame.shape[:2], -1)).permute(2, 0, 1)
    covered = box(TensorDict({"pixels": picture.clone()}))["pixels"].permute(1, 2, 0)
    return np.ascontiguousarray(covered.numpy()).reshape(frame.shape)
