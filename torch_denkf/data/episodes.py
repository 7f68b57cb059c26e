"""Episodes of a data set: what they are called, where they lie, and what each is for."""

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

ROW = "_row"  # entry of what is stored: where the row is in the whole data set, for its picture
Split = Literal["train", "validation", "test", "all"]


@dataclass(frozen=True)
class Episode:
    """Rows of a data set that follow each other in time.

    Attributes:
        name: of the episode, unique in the data set.
        start: its first row in the data set.
        length: its rows.
    """

    name: str
    start: int
    length: int

    @property
    def split_name(self) -> str:
        """Returns the name that splits hash: episodes that share it are on the same side."""
        return self.name


def hashed_share(name: str, purpose: str) -> float:
    """Returns a number in [0, 1) made of a name: those below a share are in it, and stay in it as the share grows.

    Args:
        name: of an episode.
        purpose: of the number: two purposes give independent numbers.

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
    """Assigns each episode to a split, independently of all others, so that those added later move none.

    Args:
        episodes: of the whole data set.
        for_tests: whether an episode is for tests.
        validation_share: of the others, this share is for validation, by :func:`hashed_share`.
    """
    held = [hashed_share(episode.split_name, "validation") < validation_share for episode in episodes]
    return [
        "test" if for_tests(episode) else "validation" if out else "train"
        for episode, out in zip(episodes, held, strict=True)
    ]


def episode_flags(first: Tensor, last: Tensor) -> dict[str, Any]:
    """Flags of rows: ``is_init`` where ``first``, truncated and done where ``last``, never terminated; no done at root.

    Args:
        first: bool ``[n, 1]``: the row begins an episode.
        last: bool ``[n, 1]``: it ends one.

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
    """Raises for rows that are no data set's.

    Raises:
        KeyError: if they lack ``step`` or ``time``.
        ValueError: if the episodes are not those of the rows.
    """
    missing = sorted({"step", "time"} - set(rows.keys()))
    if missing:
        raise KeyError(f"the rows of a data set have 'step' and 'time' [n, 1]; these lack {missing}")
    end = 0
    for episode in episodes:
        if episode.start != end or episode.length < 1:
            raise ValueError(f"episodes lie one behind the other, each of at least a row; {episode} comes at row {end}")
        end += episode.length
    if end != len(rows):
        raise ValueError(f"the episodes have {end} rows, but there are {len(rows)}")


def rows_of(episodes: Sequence[Episode]) -> Tensor:
    """Numbers of all rows of some episodes, ``[n]``."""
    return torch.cat([torch.arange(episode.start, episode.start + episode.length) for episode in episodes])


def select_episodes(
    rows: TensorDictBase, chosen: Sequence[Episode], single: Tensor | None
) -> tuple[TensorDict, tuple[Episode, ...]]:
    """Returns rows of the chosen episodes with their flags and numbers, and these episodes with their new places.

    Args:
        rows: of the whole data set, ``[N]``.
        chosen: some of its episodes.
        single: bool ``[N]``: take only these rows, each on its own.
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
