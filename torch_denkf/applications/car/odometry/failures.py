"""Camera failures, announced and unannounced: missing frames, black frames, partial occlusion."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict

from torch_denkf.envs import OccludingBox

__all__ = ["CameraFailure", "fail_frames"]


class CameraFailure(NamedTuple):
    """Failure of the camera over a span of frames.

    Attributes:
        kind: ``"missing"`` (the frames are known to be missing), ``"black"`` (black frames arrive) or ``"box"``
            (:class:`torch_denkf.envs.OccludingBox` occludes a part of each image).
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
        failures: failures; of overlapping ones the first counts.

    Yields:
        The images; ``None`` for a missing one. Changed images are copies.

    Raises:
        ValueError: for an unknown kind of failure.

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
