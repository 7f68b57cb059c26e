"""Constants of sub-models: numbers, lists and arrays become tensors of torch's default precision."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_denkf._checks import check_number, check_values

__all__ = [
    "as_floating",
    "as_standard_deviations",
    "check_dims",
    "mean_of_members",
    "register_constant",
    "register_location",
    "register_scale",
    "variance_and_floor",
]


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


def register_location(module: nn.Module, name: str, value: Tensor | Sequence | float | None) -> None:
    """Keeps a mean that standardises inputs: finite numbers, or ``None``.

    Raises:
        ValueError: if one is not finite.
    """
    register_constant(module, name, value)
    if value is not None:
        check_values(name, getattr(module, name))


def register_scale(module: nn.Module, name: str, value: Tensor | Sequence | float | None) -> None:
    """Keeps a standard deviation that standardises inputs: positive numbers, an infinite one hides its input.

    Raises:
        ValueError: if one is not positive.
    """
    register_constant(module, name, value)
    if value is not None:
        check_values(name, getattr(module, name), above=0, infinite=True)


def as_standard_deviations(name: str, value: Any) -> Tensor:
    """Standard deviations ``[N]``, zero where there is none.

    Raises:
        ValueError: if they have another shape, or one is negative or not finite.
    """
    std = as_floating(value)
    if std.ndim != 1:
        raise ValueError(f"{name} must be [N], one standard deviation a dimension; got {list(std.shape)}")
    check_values(f"{name}, a standard deviation,", std, least=0)
    return std


def check_dims(name: str, dims: Sequence[int], size: int | None = None) -> None:
    """Raises unless these are indices of components, of ``size`` of them where that is known.

    Raises:
        TypeError: if one is no whole number.
        ValueError: if one is negative or too large.
    """
    for index in dims:
        if isinstance(index, bool) or not hasattr(index, "__index__"):
            raise TypeError(f"{name} holds indices of components, whole numbers; got {index!r} in {list(dims)}")
        check_number(name, int(index), least=0, below=size, cure=f"The indices are {list(dims)}")


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
    std = as_floating(r)
    check_values(f"r of {owner}, a standard deviation,", std, above=0)
    variance = std.expand(size) ** 2
    check_values(f"r^2 of {owner}", variance, above=0, cure="Scale the observation, so that its variance is a number")
    floor = 0.01 * variance if floor is None else as_floating(floor).expand(size)
    check_values(f"floor of {owner}", floor, least=0)
    check_values(f"r^2 - floor of {owner}", variance - floor, above=0, cure="The floor is a variance below r^2")
    return variance - floor, floor.clone()


def mean_of_members(value: Tensor, batch_size: Sequence[int]) -> Tensor:
    """The mean of ``[*B, E, N]`` over the members; ``[*B, N]`` as it is."""
    return value.mean(-2) if value.ndim > len(batch_size) + 1 else value
