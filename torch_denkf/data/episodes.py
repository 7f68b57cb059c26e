"""Episodes of a data set: names, rows, and splits."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, cast

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

__all__ = [
    "ROW",
    "Episode",
    "Split",
    "check_rows",
    "episode_flags",
    "hashed_share",
    "hashed_tests",
    "roles_of",
    "rows_of",
    "select_episodes",
]

ROW = "_row"  # entry of stored rows: index of the row in the whole data set, which selects its image
Split = Literal["train", "validation", "test", "all"]


@dataclass(frozen=True)
class Episode:
    """Consecutive rows of a data set.

    Attributes:
        name: name of the episode, unique in the data set.
        start: its first row in the data set.
        length: number of its rows.
    """

    name: str
    start: int
    length: int

    @property
    def split_name(self) -> str:
        """Returns the name that is hashed for splits: episodes that share it are in the same split."""
        return self.name


def hashed_share(name: str, purpose: str) -> float:
    """Returns a hash of a name in [0, 1), for splits: a split takes the names whose hash is below its share.

    A name that is in a split stays there when the share grows.

    Args:
        name: name of an episode.
        purpose: salt of the hash: two purposes give independent hashes.

    Examples:
        >>> share = [hashed_share(str(k), "test") < 0.2 for k in range(1000)]
        >>> 160 < sum(share) < 240
        True
    """
    digest = hashlib.sha256(f"torch_denkf {purpose} {name}".encode()).digest()
    return int.from_bytes(digest[:8], "big") / 2**64


def hashed_tests(share: float) -> Callable[[Episode], bool]:
    """Returns a predicate that selects a share of all episodes as test split, by :func:`hashed_share`.

    Raises:
        ValueError: if the share is out of range.
    """
    if not isinstance(share, (int, float)) or not 0 <= share < 1:
        raise ValueError(f"test_share is a share of all episodes, in [0, 1), got {share!r}")
    return lambda episode: hashed_share(episode.split_name, "test") < share


def roles_of(
    episodes: Sequence[Any], for_tests: Callable[[Any], bool], validation_share: float
) -> list[Literal["train", "validation", "test"]]:
    """Assigns each episode to a split, independently of all others, so that later episodes change no assignment.

    Args:
        episodes: all episodes of the data set.
        for_tests: predicate that selects test episodes.
        validation_share: share of the other episodes for validation, by :func:`hashed_share`.
    """
    held = [hashed_share(episode.split_name, "validation") < validation_share for episode in episodes]
    return [
        "test" if for_tests(episode) else "validation" if out else "train"
        for episode, out in zip(episodes, held, strict=True)
    ]


def episode_flags(first: Tensor, last: Tensor) -> dict[str, Any]:
    """Returns torchrl's flags: ``is_init`` where ``first``, next truncated and done where ``last``, never terminated.

    Args:
        first: bool ``[n, 1]``: the row begins an episode.
        last: bool ``[n, 1]``: the row ends an episode.

    Examples:
        >>> row = torch.arange(3).unsqueeze(-1)
        >>> flags = episode_flags(row == 0, row == 2)
        >>> flags["is_init"].flatten(), flags["next"]["truncated"].flatten(), flags["done"].any()
        (tensor([ True, False, False]), tensor([False, False,  True]), tensor(False))
    """
    never = torch.zeros_like(first)
    done = {"done": last, "truncated": last.clone(), "terminated": never.clone()}
    return {"is_init": first, **{key: never.clone() for key in done}, "next": TensorDict(done, first.shape[:1])}


def check_rows(rows: TensorDictBase, episodes: Sequence[Episode]) -> None:
    """Checks that rows have their entries, and that the episodes cover them.

    Raises:
        KeyError: if ``step`` or ``time`` is missing.
        ValueError: if the episodes are not consecutive, or have another number of rows.
    """
    missing = sorted({"step", "time"} - set(rows.keys()))
    if missing:
        raise KeyError(f"the rows of a data set have 'step' and 'time' [n, 1]; these lack {missing}")
    end = 0
    for episode in episodes:
        if episode.start != end or episode.length < 1:
            raise ValueError(f"episodes are consecutive, each of at least one row; {episode} comes at row {end}")
        end += episode.length
    if end != len(rows):
        raise ValueError(f"the episodes have {end} rows, but there are {len(rows)}")


def rows_of(episodes: Sequence[Episode]) -> Tensor:
    """Returns the indices of all rows of some episodes, ``[n]``."""
    return torch.cat([torch.arange(episode.start, episode.start + episode.length) for episode in episodes])


def select_episodes(
    rows: TensorDictBase, chosen: Sequence[Episode], single: Tensor | None
) -> tuple[TensorDict, tuple[Episode, ...]]:
    """Returns rows of the chosen episodes with flags and episode numbers, and these episodes with their new starts.

    Args:
        rows: rows of the whole data set, ``[N]``.
        chosen: some of its episodes.
        single: bool ``[N]``: selects rows, each of which becomes an episode of one row.
    """
    index = rows_of(chosen)
    number = torch.arange(len(chosen)).repeat_interleave(torch.tensor([episode.length for episode in chosen]))
    first = torch.cat([torch.arange(episode.length) for episode in chosen]).unsqueeze(-1) == 0
    last = first.roll(-1, 0)
    if single is not None:
        keep = single[index]
        index, number = index[keep], number[keep]
        first = last = torch.ones(len(index), 1, dtype=torch.bool)
    stored = cast(TensorDict, rows[index])
    stored.update({"episode": number, ROW: index.unsqueeze(-1), **episode_flags(first, last)})
    lengths = torch.bincount(number, minlength=len(chosen))
    places = zip(chosen, (lengths.cumsum(0) - lengths).tolist(), lengths.tolist(), strict=True)
    return stored, tuple(replace(episode, start=start, length=length) for episode, start, length in places)
