"""Matrices of Jacobians."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def eye(like: Tensor, size: int) -> Tensor:
    """Returns the identity ``[*, size, size]`` for points ``[*, N]``."""
    return torch.eye(size, dtype=like.dtype, device=like.device).expand(*like.shape[:-1], size, size)


def blocks(parts: Sequence[Tensor]) -> Tensor:
    """Matrices on the diagonal of one."""
    sizes = [part.shape[-1] for part in parts]
    rows = []
    for place, part in enumerate(parts):
        batch = part.shape[:-1]
        before, after = part.new_zeros(*batch, sum(sizes[:place])), part.new_zeros(*batch, sum(sizes[place + 1 :]))
        rows.append(torch.cat([before, part, after], -1))
    return torch.cat(rows, -2)
