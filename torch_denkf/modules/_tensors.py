"""Constants of sub-models: numbers, lists and arrays become tensors of torch's default precision."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

__all__ = ["as_floating", "mean_of_members", "register_constant", "variance_and_floor"]


def as_floating(value: Any) -> Tensor:
    """A floating tensor: a tensor keeps its precision, everything else gets torch's default one.

    Example:
        >>> as_floating([1, 2]).dtype, as_floating(torch.ones(2, dtype=torch.float64)).dtype
        (torch.float32, torch.float64)
    """
    if isinstance(value, Tensor):
        return value if value.is_floating_point() else value.to(torch.get_default_dtype())
    return torch.as_tensor(value, dtype=torch.get_default_dtype())


def register_constant(
    module: nn.Module, name: str, value: Tensor | Sequence | float | None, *, trainable: bool = False
) -> None:
    """Keeps a constant in a module as a buffer, or as a parameter; ``None`` stays ``None``."""
    tensor = None if value is None else as_floating(value)
    if trainable and tensor is not None:
        module.register_parameter(name, nn.Parameter(tensor.clone()))
    else:
        module.register_buffer(name, tensor)


def variance_and_floor(
    owner: str, size: int, r: Tensor | Sequence[float] | float, floor: Tensor | Sequence[float] | float | None
) -> tuple[Tensor, Tensor]:
    """What a noise before training has above its floor, :math:`r^2 - c`, and the floor c, both ``[size]``.

    Args:
        owner: who asks, for the message.
        size: dimensions.
        r: standard deviation before training, a number or one for each dimension.
        floor: smallest variance c; 1 % of :math:`r^2` by default.

    Raises:
        ValueError: if ``r`` is not positive or the floor reaches :math:`r^2`.
    """
    variance = as_floating(r).expand(size) ** 2
    floor = 0.01 * variance if floor is None else as_floating(floor).expand(size)
    if not (variance > 0).all() or not (floor < variance).all() or not (floor >= 0).all():
        raise ValueError(
            f"{owner} needs r > 0 and 0 <= floor < r^2; got r^2 = {variance.tolist()}, floor = {floor.tolist()}."
        )
    return variance - floor, floor.clone()


def mean_of_members(value: Tensor, batch_size: Sequence[int]) -> Tensor:
    """The mean of ``[*B, E, N]`` over the members; ``[*B, N]`` as it is."""
    return value.mean(-2) if value.ndim > len(batch_size) + 1 else value
