"""Demos as episodes of a data set: test split, and rows."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

from tensordict import TensorDict, TensorDictBase

from torch_denkf.applications.ur5.data.files import Entry
from torch_denkf.applications.ur5.simulation.names import CONTROL_STEP, TASKS
from torch_denkf.data.episodes import Episode


@dataclass(frozen=True)
class UR5Episode(Episode):
    """One demo.

    Attributes:
        demo: its number in the collection.
        task: ``"pick"``, ``"push"`` or ``"put_down"``.
    """

    demo: int
    task: str


def is_for_tests(demo: int) -> bool:
    """Returns True for demos of the test split: a fifth of all numbers, by a hash that is independent of options."""
    digest = hashlib.sha256(f"ur5 demo {demo}".encode()).digest()
    return int.from_bytes(digest[:8], "big") % 5 == 0


def demo_rows(rows: TensorDictBase) -> TensorDict:
    """Returns rows of all demos with the keys of data sets.

    Args:
        rows: see :func:`torch_denkf.applications.ur5.data.cache.read_demos`.
    """
    return rows.exclude("frame").update({"observed": rows["frame"] >= 0, "time": rows["step"].double() * CONTROL_STEP})


def demo_episodes(rows: TensorDictBase, entries: Sequence[Entry]) -> list[UR5Episode]:
    """Returns the episodes of rows."""
    episodes, start = [], 0
    for entry in entries:
        task = TASKS[int(rows["task"][start])]
        episodes.append(UR5Episode(f"demo-{entry.demo:06d}", start, entry.rows, demo=entry.demo, task=task))
        start += entry.rows
    return episodes
