"""Foot contacts, from the forces under the feet."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_number

__all__ = ["contacts"]


def contacts(force: Tensor, on: float, off: float | None = None, *, before: Tensor | None = None) -> Tensor:
    """Detects contacts with hysteresis: a contact lasts from a force above ``on`` until a force below ``off``.

    The hysteresis prevents chatter by noise at a single threshold.

    Args:
        force: upwards, ``[*B, T, F]``, time before feet; in N.
        on: threshold above which a contact begins.
        off: threshold below which a contact ends. ``None`` for half of ``on``.
        before: contacts before the first row, ``[*B, F]`` bool; ``None`` for no contact.

    Returns:
        ``[*B, T, F]`` bool.

    Raises:
        ValueError: if ``off`` exceeds ``on``, or a force is not finite or of another shape.
        TypeError: if ``before`` is not boolean.

    Example:
        >>> contacts(torch.tensor([[10.0], [70.0], [50.0], [20.0], [50.0]]), 60.0, 30.0).flatten()
        tensor([False,  True,  True, False, False])
    """
    check_number("on", on)
    off = on / 2 if off is None else off
    check_number("off", off, most=on, cure="It is not above the threshold on")
    if not isinstance(force, Tensor) or force.ndim < 2:
        raise ValueError(f"force is a tensor [*B, T, F], time before feet; got {force!r}")
    check_number("force", force)
    if before is not None and (getattr(before, "dtype", None) != torch.bool or before.shape != force[..., 0, :].shape):
        raise TypeError(f"before is bool, [*B, F] = {list(force[..., 0, :].shape)}; got {before!r}")
    above, keeps = force > on, force > off
    stands = torch.zeros_like(above[..., 0, :]) if before is None else before
    found = []
    for row in range(force.shape[-2]):
        stands = above[..., row, :] | (stands & keeps[..., row, :])
        found.append(stands)
    return torch.stack(found, -2)
