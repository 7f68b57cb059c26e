"""Bernoulli masks from few random bits.

A dropout mask needs one decision a unit, not one floating-point number. Eight decisions come out of one
64-bit draw: each of its bytes is compared with a threshold. At the sizes of a filter step this is several
times cheaper than :func:`torch.nn.functional.dropout`, whose masks are two thirds of such a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import torch

__all__ = ["random_keep_mask", "random_signs", "representable_rate"]

_INT64_MIN = -(2**63)


def representable_rate(rate: float) -> float:
    """Returns the nearest drop probability that a byte can express, a multiple of 1/256.

    Args:
        rate: wanted drop probability in [0, 1).

    Raises:
        ValueError: if ``rate`` is outside [0, 1).

    Example:
        >>> representable_rate(0.1)
        0.1015625
    """
    if not 0.0 <= rate < 1.0:
        raise ValueError(f"rate is the probability of dropping a unit and lies in [0, 1); got {rate}.")
    return min(round(rate * 256), 255) / 256


def random_keep_mask(
    shape: Sequence[int],
    rate: float,
    *,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws a mask that is ``True`` (keep) with probability ``1 - representable_rate(rate)``.

    Args:
        shape: shape of the mask.
        rate: drop probability in [0, 1); rounded to a multiple of 1/256.
        device: where the mask is drawn.
        generator: source of randomness; torch's global one by default.

    Returns:
        A boolean tensor of shape ``shape``.

    Example:
        >>> keep = random_keep_mask((4, 1000), rate=0.25, generator=torch.Generator().manual_seed(0))
        >>> keep.shape, 0.72 < keep.float().mean() < 0.78
        (torch.Size([4, 1000]), tensor(True))
    """
    threshold = int(representable_rate(rate) * 256)
    size = prod(shape)
    if torch.compiler.is_exporting():  # random_() over the whole range cannot be written into a graph: one number less
        words = torch.randint(_INT64_MIN, -_INT64_MIN - 1, ((size + 7) // 8,), device=device)
    else:
        words = torch.empty((size + 7) // 8, dtype=torch.int64, device=device)
        words.random_(_INT64_MIN, None, generator=generator)
    return (words.view(torch.uint8)[:size] >= threshold).view(tuple(shape))


def random_signs(
    shape: Sequence[int],
    *,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws fair coins, as a boolean tensor of shape ``shape``: ``True`` stands for +1, ``False`` for -1."""
    return random_keep_mask(shape, 0.5, device=device, generator=generator)
