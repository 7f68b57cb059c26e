"""Constants of sub-models: converts numbers, lists and arrays to tensors of torch's default precision."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor, nn

from torch_denkf._checks import check_number, check_values

__all__ = [
    "as_floating",
    "as_standard_deviations",
    "as_vector",
    "check_dims",
    "mask_of",
    "mean_of_members",
    "check_untrained",
    "register_constant",
    "register_matrix",
    "register_location_and_scale",
    "variance_and_floor",
]


def as_floating(value: Any, name: str = "the constant") -> Tensor:
    """Copies a value to a floating-point tensor; a floating tensor keeps its dtype, other values get torch's default.

    Raises:
        TypeError: if it is neither a tensor nor numbers, or complex; the message has ``name``.
        ValueError: if it requires a gradient, which would be lost.

    Example:
        >>> as_floating([1, 2]).dtype, as_floating(torch.ones(2, dtype=torch.float64)).dtype
        (torch.float32, torch.float64)
    """
    try:
        tensor = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"{name} must be numbers, in a tensor or in lists of one length; got {value!r}") from error
    if tensor.is_complex():
        raise TypeError(f"{name} must be real; got {tensor.dtype}. Real and imaginary parts are two components each")
    check_untrained(name, tensor, "it is copied into a constant")
    keeps = isinstance(value, Tensor) and tensor.is_floating_point()
    return tensor.detach().to(tensor.dtype if keeps else torch.get_default_dtype(), copy=True)


def register_constant(
    module: nn.Module, name: str, value: Tensor | Sequence | float | None, *, trainable: bool = False
) -> None:
    """Registers a constant of a module as a buffer, or as a parameter; ``None`` stays ``None``."""
    given = value.detach() if trainable and isinstance(value, Tensor) else value
    tensor = None if value is None else as_floating(given, name)
    if trainable and tensor is not None:
        module.register_parameter(name, nn.Parameter(tensor))
    else:
        module.register_buffer(name, tensor)


def register_matrix(
    module: nn.Module, name: str, value: Tensor | Sequence | None, layout: str, *, trainable: bool = False
) -> None:
    """Registers a matrix of finite numbers in a module, as a buffer or as a parameter.

    Raises:
        ValueError: if it is no matrix, or one of its numbers is not finite.
    """
    register_constant(module, name, value, trainable=trainable)
    matrix = getattr(module, name)
    if matrix.ndim != 2:
        raise ValueError(f"{name} must be {layout}, got {list(matrix.shape)}")
    check_values(name, matrix)


def check_untrained(name: str, value: Any, why: str) -> None:
    """Raises if a constant requires a gradient, because it would never be trained.

    Raises:
        ValueError: if it does; the message has ``name``, the argument's name.
    """
    if isinstance(value, Tensor) and value.requires_grad:
        raise ValueError(
            f"{name} requires a gradient but would never be trained: {why}. Detach it, and choose it on validation "
            "data; or use trainable=True, or a module that learns it, if there is one"
        )


def register_location_and_scale(
    module: nn.Module, loc: Tensor | Sequence | float | None, scale: Tensor | Sequence | float | None, prefix: str = ""
) -> None:
    """Registers the mean and the standard deviation that standardise inputs, each a buffer, or ``None``.

    Args:
        module: module to register them in.
        loc: finite numbers.
        scale: positive numbers; an infinite one removes its input.
        prefix: prefix of the buffers' names, ``"loc"`` and ``"scale"``.

    Raises:
        ValueError: if a number is invalid.
    """
    for name, value, above in (("loc", loc, None), ("scale", scale, 0)):
        register_constant(module, prefix + name, value)
        if value is not None:
            check_values(prefix + name, getattr(module, prefix + name), above=above, infinite=above is not None)


def as_standard_deviations(name: str, value: Any) -> Tensor:
    """Returns standard deviations ``[N]``.

    Raises:
        ValueError: if they have another shape, or one is negative or not finite.
    """
    std = as_floating(value, name)
    if std.ndim != 1:
        raise ValueError(f"{name} must be [N], one standard deviation per dimension; got {list(std.shape)}")
    check_values(f"{name}, a standard deviation,", std, least=0)
    return std


def as_vector(name: str, value: Any, size: int, *, above: float | None = None) -> Tensor:
    """Returns finite numbers ``[size]``, from one number for all or one for each.

    Raises:
        TypeError: if they are no numbers.
        ValueError: if there are neither one nor ``size`` of them, or one is not finite or not above the limit.
    """
    vector = as_floating(value, name)
    if vector.ndim > 1 or vector.numel() not in (1, size):
        raise ValueError(f"{name} is one number, or one for each of {size}; got {list(vector.shape)}")
    check_values(name, vector, above=above)
    return vector.expand(size).clone()


def check_dims(name: str, dims: Sequence[int], size: int | None = None, *, once: bool = False) -> None:
    """Raises unless these are indices of components, below ``size`` if that is known.

    Raises:
        TypeError: if one is no whole number.
        ValueError: if one is negative or too large, or occurs twice although each may occur only ``once``.
    """
    for index in dims:
        if isinstance(index, bool) or not hasattr(index, "__index__"):
            raise TypeError(f"{name} must be indices of components, whole numbers; got {index!r} in {list(dims)}")
        check_number(name, int(index), least=0, below=size, cure=f"The indices are {list(dims)}")
    if once and len(set(dims)) < len(dims):
        raise ValueError(f"{name} names each component once; got {list(dims)}")


def variance_and_floor(
    owner: str, size: int, r: Tensor | Sequence[float] | float, floor: Tensor | Sequence[float] | float | None
) -> tuple[Tensor, Tensor]:
    """Splits initial variances into the part above the floor, :math:`r^2 - c`, and the floor c, both ``[size]``.

    Args:
        owner: name of the module, for the message.
        size: number of dimensions.
        r: standard deviation before training, one number or one for each dimension.
        floor: smallest variance c; 1 % of :math:`r^2` by default.

    Raises:
        ValueError: if ``r`` is not positive or the floor reaches :math:`r^2`.
    """
    variance = as_vector(f"r of {owner}", r, size, above=0) ** 2
    check_values(f"r^2 of {owner}", variance, above=0, cure="Scale the observation, so that r^2 is finite and positive")
    floor = 0.01 * variance if floor is None else as_vector(f"floor of {owner}", floor, size)
    check_values(f"floor of {owner}", floor, least=0)
    check_values(f"r^2 - floor of {owner}", variance - floor, above=0, cure="The floor is a variance below r^2")
    return variance - floor, floor.clone()


def mask_of(observed_key: NestedKey, out_key: NestedKey) -> dict[NestedKey, NestedKey]:
    """Maps a mask that a module derives to the mask from which it is derived, unravelled.

    Raises:
        ValueError: if both have the same key: the output of a step would be the observed mask of the next.
    """
    given, made = unravel_key(observed_key), unravel_key(out_key)
    if given == made:
        raise ValueError(
            f"out_key must differ from observed_key, {observed_key!r}: else one black image would mask all later ones"
        )
    return {made: given}


def mean_of_members(value: Tensor, batch_size: Sequence[int]) -> Tensor:
    """Returns the mean of ``[*B, E, N]`` over the members; ``[*B, N]`` unchanged."""
    return value.mean(-2) if value.ndim > len(batch_size) + 1 else value
