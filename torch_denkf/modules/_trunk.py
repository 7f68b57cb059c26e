"""Runs an image trunk within a memory budget: by chunks of frames, recomputed activations, and reduced precision."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.checkpoint import checkpoint

__all__ = ["activation_bytes", "couples_frames", "in_chunks", "reduced_precision"]


_BATCH_NORMS = (nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm)


def _tensors(values: Any) -> Iterator[Tensor]:
    """Yields the tensors in nested tuples, lists and dictionaries."""
    if isinstance(values, Tensor):
        yield values
    elif isinstance(values, dict):
        yield from _tensors(tuple(values.values()))
    elif isinstance(values, (tuple, list)):
        for value in values:
            yield from _tensors(value)


class _Allocations(TorchDispatchMode):
    """Adds up the bytes of all new storages that operations return."""

    def __init__(self):
        super().__init__()
        self.bytes = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        out = function(*args, **(kwargs or {}))
        known = {tensor.untyped_storage().data_ptr() for tensor in _tensors((args, kwargs))}
        for tensor in _tensors(out):
            if tensor.untyped_storage().data_ptr() not in known:
                self.bytes += tensor.untyped_storage().nbytes()
        return out


def activation_bytes(trunk: nn.Module, frame: Tensor) -> int:
    """Returns the bytes of all tensors that ``trunk`` computes for ``frame``, ``[1, *event]``.

    Example:
        >>> activation_bytes(nn.Sequential(nn.Flatten(), nn.ReLU()), torch.zeros(1, 2, 3, dtype=torch.float32))
        24
    """
    with torch.no_grad(), _Allocations() as seen:
        trunk(frame)
    return seen.bytes


def couples_frames(trunk: nn.Module) -> bool:
    """Tells whether a batch norm makes a frame's features depend on other frames in its chunk."""
    return any(isinstance(module, _BATCH_NORMS) for module in trunk.modules())


def reduced_precision(dtype: torch.dtype | None, device: torch.device) -> AbstractContextManager:
    """Autocasts to ``dtype``; does nothing for ``None``."""
    return nullcontext() if dtype is None else torch.autocast(device.type, dtype)


def in_chunks(
    encode: Callable[..., Tensor], frames: Tensor, seen: Tensor | None, *, at_once: int | None, recompute: bool
) -> Tensor:
    """Encodes frames in chunks.

    Args:
        encode: maps frames ``[M, *event]`` and their mask ``[M, ...]`` (or ``None``) to features ``[M, F]``.
        frames: ``[N, *event]``.
        seen: mask ``[N, ...]`` or ``None``.
        at_once: the largest M; ``None`` for all.
        recompute: whether to store only a chunk's input for the backward pass, and to recompute the rest there
            (activation checkpointing).

    Returns:
        Features ``[N, F]``.

    Example:
        >>> def encode(frames, seen):
        ...     return frames.flatten(1) * len(frames)
        >>> in_chunks(encode, torch.ones(5, 1), None, at_once=2, recompute=False).flatten().tolist()
        [2.0, 2.0, 2.0, 2.0, 1.0]
    """
    if recompute and torch.is_grad_enabled():

        def run(part: Tensor, mask: Tensor | None) -> Tensor:
            return checkpoint(encode, part, mask, use_reentrant=False)
    else:
        run = encode
    count = len(frames)
    if at_once is None or count <= at_once:
        return run(frames, seen)
    masks = [None] * -(-count // at_once) if seen is None else seen.split(at_once)
    return torch.cat([run(part, mask) for part, mask in zip(frames.split(at_once), masks, strict=True)])
