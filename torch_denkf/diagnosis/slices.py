"""Raises if a flat batch has several concatenated sequences without marks of their beginnings."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torch_denkf._slices import starts_of
from torch_denkf.diagnosis.once import Once
from torch_denkf.filters.base import Filter
from torch_denkf.filters.finish import Record

__all__ = ["UnmarkedSlices", "check_slices"]

#: Last names of entries that number an episode, and of those that count its steps.
_EPISODES = ("episode", "episode_index", "traj_ids")
_CLOCKS = ("step", "step_count", "frame_index", "time", "timestamp")
_FLAGS = ("done", "terminated", "truncated", "is_init", "reward")
_CURE = (
    "Sequences are [*B, T], time last. TensorDictReplayBuffer writes torchrl's marks of slices into the batch, "
    "ReplayBuffer leaves them out. Use TensorDictReplayBuffer; or reshape slices of one length, batch.reshape(-1, T); "
    "or, if this is one sequence after all, pass batch[None]."
)


class UnmarkedSlices(Once):
    """Raises if the batch of a loss has concatenated slices of episodes without marks of their beginnings."""

    ways = ("data",)

    def __call__(self, filter: Filter, record: Record) -> None:
        """Looks at a flat batch, see :func:`check_slices`."""
        check_slices(record.tensordict, filter.init_key)


def check_slices(tensordict: TensorDictBase, init_key: NestedKey) -> None:
    """Raises for a batch ``[N]`` that seems to hold several sequences and does not say where they begin.

    A filter would go from the end of one slice to the beginning of the next as if no time had passed. Frames without a
    ``"next"`` part, a number of the episode and a clock are taken for one sequence, and so is what continues without a
    break: what was next at one step is there at the following one, as in ``env.rollout``.

    Args:
        tensordict: any batch; only one with a single batch dimension is looked at.
        init_key: marks the first element of an episode, e.g. ``"is_init"``.

    Raises:
        ValueError: if something breaks where no beginning is marked: the number of an episode (``"episode"``,
            ``"traj_ids"``), a clock (``"step"``, ``"time"``), an episode that is done, or what was next. Or if there is
            a ``"next"`` part in which nothing can tell.

    Example:
        >>> from tensordict import TensorDict
        >>> rows = TensorDict({"y": torch.zeros(4, 1), "episode": torch.tensor([0, 0, 1, 1])}, [4])
        >>> check_slices(rows, "is_init")
        Traceback (most recent call last):
        ...
        ValueError: The batch [4] seems to hold several sequences: 'episode' changes at 2, and nothing marks ...
        >>> rows["is_init"] = torch.tensor([True, False, True, False])
        >>> check_slices(rows, "is_init")
    """
    if tensordict.ndim != 1 or tensordict.batch_size[0] < 2 or torch.compiler.is_compiling():
        return
    size = tensordict.batch_size[0]
    marks = starts_of(tensordict, init_key)
    inner = torch.ones(size - 1, dtype=torch.bool, device=tensordict.device)
    inner = inner if marks is None else ~marks.reshape(size)[1:]
    # A sampler that marks slices marks the first, too; a done marks what comes after it.
    marked = marks is not None and bool(marks.reshape(size)[0])

    for key, numbers in _named(tensordict, _EPISODES):
        _refuse(f"{key!r} changes", (numbers.diff() != 0) & inner, size)
    told = False
    for key, clock in _named(tensordict, _CLOCKS):
        _refuse(f"{key!r} does not go on", _breaks(clock, inner, strict=not marked), size)
        told = True
    following = tensordict.get("next", None)
    if not isinstance(following, TensorDictBase):
        return
    ends = _end(following, size)
    if ends is not None:
        _refuse("an episode is done, and the next begins,", ends[:-1] & inner, size)
    compared, broken = _chain(tensordict, following, inner)
    _refuse("what was next is not what follows", broken, size)
    if compared or told or marked:
        return
    if ends is None or not ends[-1]:  # torchrl's sampler ends every slice; so does a rollout that came to its end
        raise ValueError(
            f"The batch [{size}] may hold several sequences, and nothing says where they begin: its 'next' part shares "
            f"no entry with it, and the last of its elements is not done. {_CURE}"
        )


def _refuse(what: str, broken: Tensor, size: int) -> None:
    if broken.any():
        at = int(broken.nonzero()[0]) + 1
        raise ValueError(
            f"The batch [{size}] seems to hold several sequences: {what} at {at}, and nothing marks that one begins "
            f"there. {_CURE}"
        )


def _named(tensordict: TensorDictBase, names: tuple[str, ...]) -> Iterator[tuple[NestedKey, Tensor]]:
    """Yields entries ``[N]`` of some last names, outside of the next step's."""
    for key in map(unravel_key, tensordict.keys(True, True)):
        first, last = (key, key) if isinstance(key, str) else (key[0], key[-1])
        if last in names and first not in ("next", "previous"):
            value = tensordict.get(key)
            if isinstance(value, Tensor) and value.numel() == tensordict.batch_size[0] and value.dtype != torch.bool:
                yield key, value.reshape(-1)


def _breaks(clock: Tensor, inner: Tensor, *, strict: bool) -> Tensor:
    """Marks steps, among ``inner``, at which a clock stands still, runs back, or (``strict``) leaps."""
    steps = clock.double().diff()
    if not inner.any():
        return inner
    usual = steps[inner].median()
    leaps = steps * usual.sign() > 1.5 * usual.abs() if strict else torch.zeros_like(inner)
    return inner & ((steps * usual.sign() <= 0) | leaps)


def _end(following: TensorDictBase, size: int) -> Tensor | None:
    """Returns the last elements of episodes, ``[N]``; ``None`` where nothing says."""
    values = [following.get(name, None) for name in ("done", "truncated")]
    ends = [value.reshape(size, -1).any(-1) for value in values if value is not None]
    return torch.stack(ends).any(0) if ends else None


def _chain(tensordict: TensorDictBase, following: TensorDictBase, inner: Tensor) -> tuple[bool, Tensor]:
    """Compares the next step's entries with the following rows: whether that is possible, and breaks ``[N - 1]``.

    A transform of sampled data may change one entry and not its next one, and a robot may stand still. So one entry
    that moves and continues is enough, and a step in which all are the same.
    """
    pairs = []
    for key in map(unravel_key, following.keys(True, True)):
        last = key if isinstance(key, str) else key[-1]
        first = key if isinstance(key, str) else key[0]
        now, after = tensordict.get(key, None), following.get(key)
        comparable = isinstance(now, Tensor) and isinstance(after, Tensor) and now.shape == after.shape
        if comparable and last not in _FLAGS and first not in ("previous", "noise"):
            pairs.append((now, after))
    pairs.sort(key=lambda pair: pair[0].numel())  # the images last: they are rarely needed
    all_same, goes_on = torch.ones_like(inner), ~inner
    for now, after in pairs:
        size = now.shape[0]
        now, after = now.detach().reshape(size, -1), after.detach().reshape(size, -1)
        same = _equal(after[:-1], now[1:])
        goes_on = goes_on | (same & ~_equal(after[:-1], now[:-1]))
        all_same = all_same & same
        if goes_on.all():
            break
    return bool(pairs), torch.zeros_like(inner) if not pairs else inner & ~(goes_on | all_same)


def _equal(first: Tensor, second: Tensor) -> Tensor:
    """Masks rows that are equal; NaN equals NaN."""
    same = first == second
    if first.is_floating_point():
        same = same | (first.isnan() & second.isnan())
    return same.all(-1)
