"""Bernoulli masks from few random bits.

A dropout mask needs one decision per unit, not one floating-point number. One 64-bit draw gives eight decisions: each
of its bytes is compared with a threshold. At the sizes of a filter step this is several times cheaper than
:func:`torch.nn.functional.dropout`, whose masks take two thirds of such a step.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import prod

import torch

from torch_denkf.functional.kernels.small_system import made_once, on_gpu

__all__ = ["balanced_bytes", "dropout_factor", "random_bytes", "random_signs", "representable_rate"]

_INT64_MIN = -(2**63)
_GOLDEN = 0.6180339887498949


def representable_rate(rate: float) -> float:
    """Returns the nearest drop probability that a byte can express, a multiple of 1/256.

    Args:
        rate: wanted drop probability in [0, 1).

    Raises:
        ValueError: if ``rate`` is outside [0, 1), or so small that no byte can express it.

    Example:
        >>> representable_rate(0.1)
        0.1015625
    """
    if not isinstance(rate, (int, float)) or not 0.0 <= rate < 1.0:
        raise ValueError(f"rate is the probability of dropping a unit and lies in [0, 1); got {rate!r}.")
    if 0 < rate < 1 / 512:
        raise ValueError(
            f"rate is rounded to a multiple of 1/256, so that {rate} would drop no unit at all; pass 0 for that, or at "
            "least 0.002."
        )
    return min(round(rate * 256), 255) / 256


def random_bytes(
    shape: Sequence[int], *, device: torch.device | str | None = None, generator: torch.Generator | None = None
) -> torch.Tensor:
    """Draws independent bytes, uniform in 0 to 255, eight out of one 64-bit number.

    Args:
        shape: shape of the result.
        device: device of the result.
        generator: source of randomness; torch's global one by default.

    Returns:
        A uint8 tensor of shape ``shape``.

    Example:
        >>> draws = random_bytes((1000, 8), generator=torch.Generator().manual_seed(0))
        >>> draws.dtype, 126 < draws.float().mean() < 129
        (torch.uint8, tensor(True))
    """
    size = prod(shape)
    count = (size + 7) // 8
    if torch.compiler.is_exporting():  # random_() over the whole range cannot be exported, so the range is one smaller
        words = torch.randint(_INT64_MIN, -_INT64_MIN - 1, (count,), device=device)
    else:
        try:
            words = torch.empty(count, dtype=torch.int64, device=device)
            words.random_(_INT64_MIN, None, generator=generator)
        except RuntimeError:  # under torch.vmap only tensors created there can differ between rows
            words = torch.randint(_INT64_MIN, -_INT64_MIN - 1, (count,), device=device, generator=generator)
    return words.view(torch.uint8)[:size].view(tuple(shape))


def balanced_bytes(
    batch_size: Sequence[int],
    members: int,
    units: int,
    *,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> torch.Tensor:
    """Draws bytes without replacement across each unit's members, so that dropout drops equally many for all units.

    Each single byte is uniform in 0 to 255, and bytes of different units are independent. The bytes of one unit are
    256 / E apart, in random order: of E members floor(rate E) or one more are dropped. So the ensemble's mean is
    nearer to the mean of infinitely many members than with independent bytes, for a few more random bits.

    Args:
        batch_size: ``[*B]``.
        members: E.
        units: H, of all layers.
        device: device of the result.
        generator: source of randomness; torch's global one by default.

    Returns:
        A uint8 tensor ``[*B, E, H]``.

    Example:
        >>> draws = balanced_bytes((), 32, 1000)
        >>> (draws < 64).sum(0).unique()
        tensor([8])
    """
    offset, order = random_bytes((2, *batch_size, 1, units), device=device, generator=generator).unbind(0)
    orders = _orders(members, torch.device("cpu") if device is None else torch.device(device))
    if 256 % members == 0:  # bytes wrap by themselves
        return offset + orders * (order | 1)
    chosen = orders[order.squeeze(-2).long() * len(orders) // 256]
    return offset + chosen.mT.contiguous()


def _orders(members: int, device: torch.device) -> torch.Tensor:
    """Returns the possible orders of one unit's bytes, ``[N, E]``, or one ``[E, 1]`` to be multiplied."""

    def make() -> torch.Tensor:
        number = torch.arange(members)
        if 256 % members == 0:
            orders = number.unsqueeze(-1)
        else:  # ranks of multiples of different angles, which give any two members all distances
            angles = torch.arange(1, max(2, min(257, 2**22 // members)), dtype=torch.float64) * _GOLDEN
            orders = (angles.unsqueeze(-1) * number % 1).argsort(-1).argsort(-1)
        return (orders * 256 // members).to(torch.uint8).to(device)

    return made_once(("orders", members, device), make)


def dropout_factor(draws: torch.Tensor, rate: float, dtype: torch.dtype) -> torch.Tensor:
    """Turns random bytes, or a mask of kept units, into dropout factors: 0, or 1 / (1 - rate) if kept.

    A byte b is kept if ``b >= 256 * rate``. As a line in b, clamped at both values, this is vectorised, which
    comparisons of bytes and products with booleans are not: they take half of the time of dropout.

    Args:
        draws: uint8 of :func:`random_bytes`, or boolean, ``True`` where kept.
        rate: drop probability, a multiple of 1/256 (see :func:`representable_rate`).
        dtype: dtype of the result.

    Returns:
        Factors of the shape of ``draws``.

    Example:
        >>> dropout_factor(torch.tensor([0, 63, 64, 255], dtype=torch.uint8), 0.25, torch.float32)
        tensor([0.0000, 0.0000, 1.3333, 1.3333])
    """
    kept = 1 / (1 - rate)
    if draws.dtype != torch.bool and on_gpu(draws):
        draws = draws >= round(256 * rate)
    if draws.dtype == torch.bool:
        return draws * kept if dtype == torch.get_default_dtype() else draws.to(dtype) * kept
    # Per byte the line rises by 1024, more than twice the largest factor (256): at the first kept byte it is twice
    # the factor, at the byte before it is negative, whatever the rounding. So the clamped values are exact.
    line = draws.to(torch.promote_types(dtype, torch.float32))  # a copy, so in place from here
    return line.mul_(1024).add_(2 * kept - 1024 * round(256 * rate)).clamp_(0.0, kept).to(dtype)


def random_signs(
    shape: Sequence[int], *, device: torch.device | str | None = None, generator: torch.Generator | None = None
) -> torch.Tensor:
    """Draws fair coins, as a boolean tensor of shape ``shape``: ``True`` stands for +1, ``False`` for -1."""
    return random_bytes(shape, device=device, generator=generator) >= 128
