"""What the filters estimate: the right arm's joints, or the right hand's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from benchmarks.g1.recordings import JOINTS, READ
from benchmarks.g1.sensors import FINGER_UNIT, JOINT_UNIT


@dataclass(frozen=True)
class Target:
    """Some of the numbers that a sensor reads.

    Attributes:
        name: of the state.
        dims: which of the 13 numbers.
        unit: an error that counts as one.
        encoders: which of its numbers have a noisy encoder, where a filter reads encoders.
        encoder_std: standard deviation of their noise.
    """

    name: str
    dims: range
    unit: float
    encoders: Sequence[int] = ()
    encoder_std: float = 0.0

    @property
    def size(self) -> int:
        """Numbers."""
        return len(self.dims)


# Shoulder pitch and elbow are hardly seen by the camera, and elbow is what sensors read worst. 3 degrees of noise.
ARM = Target("arm", range(JOINTS), JOINT_UNIT, (0, 3), 0.0524)
HAND = Target("hand", range(JOINTS, READ), FINGER_UNIT)
TARGETS = {"arm": ARM, "hand": HAND}
