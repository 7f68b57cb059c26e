"""Shares among the studies of arms behind a camera: readings, motions, recipes, training, scores and pages."""

from __future__ import annotations

from dataclasses import dataclass

JOINTS = 7  # of each arm: the first components of a state, in rad


@dataclass(frozen=True)
class Roles:
    """Indices of recorded sequences by their use.

    Filters learn from sequences that their sensor was not trained on, because its errors on those are larger.
    """

    sensor: list[int]  # train the sensor and the motion
    tune: list[int]  # train the filters
    validation: list[int]  # choose settings
    test: list[int]

    def __post_init__(self):
        everyone = [*self.sensor, *self.tune, *self.validation, *self.test]
        if len(set(everyone)) < len(everyone):
            raise ValueError(f"sequences with two roles: {sorted({e for e in everyone if everyone.count(e) > 1})}")
        for name in ("sensor", "tune", "validation", "test"):
            if not getattr(self, name):
                raise ValueError(f"no sequences are left for {name!r}; record more, or ask for fewer of the others")
