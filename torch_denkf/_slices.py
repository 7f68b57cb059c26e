"""First elements of sequences in data: marks of episodes and slices, and splitting of concatenated slices."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

__all__ = ["as_rows", "device_of", "one_earlier", "starts_of"]

#: Entries that mark the last element of an episode.
_ENDS = ("done", "truncated")


def starts_of(tensordict: TensorDictBase, init_key: NestedKey, *, step: bool = False) -> Tensor | None:
    """Marks the first elements of episodes or slices, ``[*B, T, 1]``; ``None`` without any mark.

    An element is a first one if ``is_init`` marks it, or if the element before has a ``done`` at its root, as in the
    ``"next"`` part of data, which torchrl's losses filter, too. Without ``is_init``, it is also a first one if the
    element before has a ``done`` under ``"next"``. ``"truncated"`` counts like ``"done"``, and marks in groups of
    agents like those at the root.

    Args:
        tensordict: ``[*B, T]``.
        init_key: key of the mark ``is_init``.
        step: whether ``tensordict`` is one step ``[*B]``, for which only ``is_init`` counts.
    """
    if step:
        return _marks(tensordict, tensordict, init_key)[0]
    is_init, *ends = _marks(tensordict, tensordict, init_key, *_ENDS)
    done, following = _either(*ends), tensordict.get("next", None)
    if is_init is None and isinstance(following, TensorDictBase):
        done = _either(done, _either(*_marks(following, tensordict, *_ENDS)))
    if done is None:
        return is_init
    time = tensordict.ndim - 1
    after = torch.cat([torch.zeros_like(done.narrow(time, 0, 1)), done.narrow(time, 0, done.shape[time] - 1)], time)
    return after if is_init is None else is_init | after


def device_of(tensordict: TensorDictBase) -> torch.device | None:
    """Returns the device of a tensordict, or of its first tensor if the tensordict has none."""
    found = (value.device for value in tensordict.values(True, True) if isinstance(value, Tensor))
    return tensordict.device or next(found, None)


def as_rows(tensordict: TensorDictBase, new: Tensor | None) -> tuple[TensorDictBase, Tensor | None]:
    """Returns slices of equal length in a flat ``[N]`` as ``[N / L, L]``; other data unchanged."""
    if tensordict.ndim != 1 or new is None or torch.compiler.is_compiling():
        return tensordict, new
    size, marks = tensordict.batch_size[0], new.reshape(-1).cpu()  # waits for the device once
    if not marks[1:].any():
        return tensordict, new
    for length in range(1, size // 2 + 1):
        if size % length == 0 and marks[::length][1:].all():
            return tensordict.reshape(-1, length), new.reshape(-1, length, 1)
    return tensordict, new


def one_earlier(value: Tensor, time: int) -> Tensor:
    """Shifts elements by one step to later times; the first element is repeated."""
    count = value.shape[time]
    return torch.cat([value.narrow(time, 0, 1), value.narrow(time, 0, count - 1)], time)


def _either(first: Tensor | None, second: Tensor | None) -> Tensor | None:
    return second if first is None else first if second is None else first | second


def _marks(source: TensorDictBase, tensordict: TensorDictBase, *keys: NestedKey) -> list[Tensor | None]:
    """Returns marks ``[*B, T, 1]`` for each key: the root's, or whether any agent in any group is marked."""
    values = [source.get(key, None) for key in keys]
    nested = []
    if any(value is None for value in values):
        nested = [key for key in map(unravel_key, source.keys(True, True)) if isinstance(key, tuple)]
        nested = [key for key in nested if key[0] not in ("next", "previous")]

    def mark(key: NestedKey, value: Tensor | None) -> Tensor | None:
        if value is not None:
            return _any(value, tensordict.ndim)
        name = key if isinstance(key, str) else key[-1]
        found = [_any(source.get(other), tensordict.ndim) for other in nested if other[-1] == name]
        return torch.stack(found).any(0) if found else None

    return [mark(key, value) for key, value in zip(keys, values, strict=True)]


def _any(mark: Tensor, ndim: int) -> Tensor:
    """Tells whether any agent's mark is set, ``[*B, T, 1]``."""
    return mark.flatten(ndim).any(-1, keepdim=True) if mark.ndim > ndim else mark.unsqueeze(-1)
