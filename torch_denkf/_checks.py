"""Checks of arguments from outside: the message names the argument and its value, and says what to pass.

There are three kinds. Shapes and dtypes are known without a tensor's values, so functions check them everywhere, also
under ``torch.compile``. Numbers and constants are checked by constructors, which see their values. Text is checked by
readers, which add the file and the line.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor

__all__ = [
    "check_choice",
    "check_count",
    "check_covariance",
    "check_ensemble",
    "check_mask",
    "check_number",
    "check_observed",
    "check_one_dtype",
    "check_shape",
    "check_square",
    "check_values",
    "flag_value",
    "has_values",
]


# ------------------------------------------------------------------------------------------------- shapes and dtypes


def check_shape(name: str, tensor: Tensor, shape: Sequence[int], layout: str) -> None:
    """Raises unless ``tensor`` has exactly this shape.

    Args:
        name: the argument's name, for the message.
        tensor: the argument.
        shape: the shape it must have.
        layout: the shape in words, such as ``"[*B, E, O]"``.

    Raises:
        ValueError: if the shape differs.
    """
    if tensor.shape != tuple(shape):
        raise ValueError(
            f"{name} must be {layout} = {list(shape)}, got {list(tensor.shape)}; reshape or expand it first"
        )


def check_shapes(*checks: tuple[str, Tensor, Sequence[int], str]) -> None:
    """Makes several checks, each of which takes the arguments of :func:`check_shape`."""
    for name, tensor, shape, layout in checks:
        check_shape(name, tensor, shape, layout)


def check_ensemble(name: str, ensemble: Tensor, min_size: int = 1) -> None:
    """Raises unless ``ensemble`` is ``[*B, E, S]`` with ``E >= min_size``.

    Args:
        name: the argument's name, for the message.
        ensemble: the argument.
        min_size: the smallest size allowed.

    Raises:
        ValueError: if there are too few dimensions or members.
    """
    if ensemble.ndim < 2:
        raise ValueError(
            f"{name} must be [*B, E, S] (members, then components), got {list(ensemble.shape)}; "
            "add the missing dimension with unsqueeze"
        )
    if ensemble.shape[-2] < min_size:
        raise ValueError(
            f"{name} has E = {ensemble.shape[-2]} members in shape {list(ensemble.shape)}, "
            f"but at least {min_size} are needed; use a larger ensemble"
        )


def check_one_dtype(**tensors: Tensor | None) -> None:
    """Raises unless all tensors have the dtype of the first.

    Args:
        **tensors: the arguments by name; ``None`` is skipped.

    Raises:
        TypeError: if two differ.

    Example:
        >>> check_one_dtype(mean=torch.zeros(1), cov=torch.zeros(1, 1, dtype=torch.float64))
        Traceback (most recent call last):
        ...
        TypeError: cov is torch.float64 and mean is torch.float32; convert one of them, e.g. cov.to(mean.dtype)
    """
    first: tuple[str, torch.dtype] | None = None
    for name, tensor in tensors.items():
        if tensor is None:
            continue
        if first is None:
            first = name, tensor.dtype
        elif tensor.dtype != first[1]:
            raise TypeError(
                f"{name} is {tensor.dtype} and {first[0]} is {first[1]}; convert one of them, e.g. "
                f"{name}.to({first[0]}.dtype)"
            )


def check_observed(mask: Tensor, batch: Sequence[int], dim: int) -> None:
    """Raises unless ``observed`` is boolean, ``[*B, 1]`` or ``[*B, O]``.

    Raises:
        ValueError: if it is not.
    """
    check_mask("observed", mask)
    check_shape("observed", mask, (*batch, 1 if mask.ndim and mask.shape[-1] == 1 else dim), "[*B, 1] or [*B, O]")


def check_mask(name: str, mask: Tensor | None) -> None:
    """Raises unless a mask is boolean, or ``None``.

    Raises:
        ValueError: if it has another dtype.
    """
    if mask is not None and mask.dtype != torch.bool:
        raise ValueError(f"{name} must be boolean, got {mask.dtype}; pass {name}.bool()")


# ----------------------------------------------------------------------------------------------- numbers and constants


def check_number(
    name: str,
    value: Any,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    cure: str = "",
) -> None:
    """Raises unless ``value`` is a finite number within limits; of a tensor, all values must be.

    Args:
        name: the argument's name, for the message.
        value: the argument.
        above: exclusive lower limit.
        least: inclusive lower limit.
        below: exclusive upper limit.
        most: inclusive upper limit.
        cure: advice, appended to the message.

    Raises:
        TypeError: if it is no number.
        ValueError: if it is out of range.

    Example:
        >>> check_number("relaxation", 2, least=0, most=1)
        Traceback (most recent call last):
        ...
        ValueError: relaxation must be finite, at least 0 and at most 1; got 2
    """
    if isinstance(value, Tensor):
        check_values(name, value, above=above, least=least, below=below, most=most, cure=cure)
        return
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} must be a number, got {value!r} ({type(value).__name__})" + _end(cure))
    if not (math.isfinite(value) and all(_kept(float(value), above, least, below, most))):
        raise ValueError(f"{name} must be {_range(above, least, below, most)}; got {value!r}" + _end(cure))


def check_count(name: str, value: Any, *, least: int = 1, most: int | None = None, cure: str = "") -> None:
    """Raises unless ``value`` is a whole number, at least ``least``, and at most ``most`` if that is given.

    Raises:
        TypeError: if it is no whole number.
        ValueError: if it is too small or too large.

    Example:
        >>> check_count("ensemble_size", -3)
        Traceback (most recent call last):
        ...
        ValueError: ensemble_size must be a whole number, at least 1; got -3
    """
    due = f"{name} must be a whole number, at least {least}" + ("" if most is None else f" and at most {most}")
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise TypeError(f"{due}; got {value!r} ({type(value).__name__})" + _end(cure))
    if int(value) < least or (most is not None and int(value) > most):
        raise ValueError(f"{due}; got {value!r}" + _end(cure))


def check_choice(name: str, value: Any, choices: Sequence[str | None]) -> None:
    """Raises unless ``value`` is one of several words.

    Raises:
        ValueError: if it is none of them.

    Example:
        >>> check_choice("scheme", "sqrt", ["soft", "hard", None])
        Traceback (most recent call last):
        ...
        ValueError: scheme is "soft", "hard" or None; got 'sqrt'.
    """
    if value not in choices:
        *others, last = ("None" if choice is None else f'"{choice}"' for choice in choices)
        raise ValueError(f"{name} is {', '.join(others)} or {last}; got {value!r}.")


def check_values(
    name: str,
    tensor: Tensor,
    *,
    above: float | None = None,
    least: float | None = None,
    below: float | None = None,
    most: float | None = None,
    infinite: bool = False,
    cure: str = "",
) -> None:
    """Raises unless all values of a constant are finite and within limits; a tensor on "meta" passes.

    Args:
        name: the argument's name, for the message.
        tensor: the argument.
        above: exclusive lower limit.
        least: inclusive lower limit.
        below: exclusive upper limit.
        most: inclusive upper limit.
        infinite: whether infinity is allowed.
        cure: advice, appended to the message.

    Raises:
        ValueError: if a value fails; the message has its index.
    """
    if not _has_values(tensor):
        return
    values = tensor.detach()
    good = ~values.isnan() if infinite else values.isfinite()
    for kept in _kept(values, above, least, below, most):
        good = good & kept
    if not bool(good.all()):
        at = (~good).nonzero()[0].tolist()
        value = values[tuple(at)].item()
        where = f" at {at}" if at else ""
        raise ValueError(
            f"{name} must be {_range(above, least, below, most, infinite)}; got {value!r}{where}" + _end(cure)
        )


def check_square(name: str, matrix: Tensor, size: int | None = None, layout: str = "[S, S]") -> None:
    """Raises unless ``matrix`` is square, and of ``size`` if that is given.

    Raises:
        ValueError: if it is not.
    """
    square = matrix.ndim == 2 and matrix.shape[0] == matrix.shape[1]
    if not square or (size is not None and matrix.shape[0] != size):
        expected = layout if size is None else f"{layout} = {[size, size]}"
        raise ValueError(f"{name} must be {expected}, got {list(matrix.shape)}")


def check_covariance(name: str, cov: Tensor, size: int | None = None, layout: str = "[S, S]") -> None:
    """Raises unless a constant is a covariance: square, finite, symmetric and positive semi-definite, up to rounding.

    Correlations are tested, so that the units of the components do not matter.

    Args:
        name: the argument's name, for the message.
        cov: the argument, ``[N, N]``.
        size: N, if it is known.
        layout: the shape in words.

    Raises:
        ValueError: if it is no covariance.

    Example:
        >>> check_covariance("cov", torch.tensor([[1.0, 2.0], [2.0, 1.0]]))
        Traceback (most recent call last):
        ...
        ValueError: cov must be positive semi-definite; its correlations have the eigenvalue -1. Pass A @ A.T ...
    """
    if cov.ndim == 1:
        raise ValueError(
            f"{name} must be a covariance {layout}, got {list(cov.shape)}; "
            "for standard deviations pass torch.diag(std**2)"
        )
    check_square(name, cov, size, layout)
    check_values(name, cov)
    if not _has_values(cov):
        return
    matrix = cov.detach().to("cpu", torch.float64)
    variance = matrix.diagonal()
    check_values(f"{name}, a covariance, on its diagonal", variance, least=0)
    std = variance.sqrt()
    inverse = torch.where(std > 0, 1 / torch.where(std > 0, std, 1), 0)
    rounding = 100 * max(len(matrix), 1) * torch.finfo(cov.dtype).eps
    correlation = matrix * inverse.unsqueeze(-1) * inverse
    away = (correlation - correlation.mT).abs()
    empty = (std == 0).unsqueeze(-1) | (std == 0)
    wrong = (away > rounding) | (empty & (matrix != 0))
    if bool(wrong.any()):
        row, column = wrong.nonzero()[0].tolist()
        raise ValueError(
            f"{name} must be a symmetric covariance; it has {matrix[row, column]:g} at {[row, column]} and "
            f"{matrix[column, row]:g} at {[column, row]}, with variances {variance[row]:g} and {variance[column]:g}. "
            "Pass (P + P.T) / 2, and zero next to a variance of zero"
        )
    lowest = float(torch.linalg.eigvalsh((correlation + correlation.mT) / 2)[0]) if len(matrix) else 0.0
    if lowest < -rounding:
        raise ValueError(
            f"{name} must be positive semi-definite; its correlations have the eigenvalue {lowest:.3g}. Pass A @ A.T "
            "of a root A, or the sample covariance of more samples than dimensions"
        )


def has_values(tensor: Tensor) -> bool:
    """Tells whether a tensor's values can be read: not on "meta", in a fake tensor, under vmap, or in a traced graph.

    Example:
        >>> has_values(torch.ones(2)), has_values(torch.ones(2, device="meta"))
        (True, False)
    """
    return not torch.compiler.is_compiling() and flag_value(tensor.detach().flatten()[:0].isnan().any()) is not None


def flag_value(flag: Tensor) -> bool | None:
    """Returns the value of a boolean tensor without dimensions; ``None`` without a value, see :func:`has_values`.

    Example:
        >>> flag_value(torch.tensor(True)), flag_value(torch.tensor(True, device="meta"))
        (True, None)
    """
    # Reading a value during graph capture is an error.
    if torch.compiler.is_compiling() or flag.is_meta or (flag.is_cuda and torch.cuda.is_current_stream_capturing()):
        return None
    try:
        return bool(flag)
    except RuntimeError:  # raised by vmap and fake tensors
        return None


def _has_values(tensor: Tensor) -> bool:
    """Tells whether a constant's values can be read; another class of tensors may forbid it."""
    return type(tensor) in (Tensor, torch.nn.Parameter) and has_values(tensor)


def _kept(value: Any, *limits: float | None) -> list[Any]:
    """Tells which limits a number or each value of a tensor keeps; limits in the order of :func:`check_number`."""
    compare = (operator.gt, operator.ge, operator.lt, operator.le)
    return [kept(value, limit) for kept, limit in zip(compare, limits, strict=True) if limit is not None]


def _range(above=None, least=None, below=None, most=None, infinite: bool = False) -> str:
    words = [] if infinite else ["finite"]
    words += [f"above {above:g}"] if above is not None else []
    words += [f"at least {least:g}"] if least is not None else []
    words += [f"below {below:g}"] if below is not None else []
    words += [f"at most {most:g}"] if most is not None else []
    return " and ".join(", ".join(words).rsplit(", ", 1)) if words else "a number, not NaN"


def _end(cure: str) -> str:
    return f". {cure}" if cure else ""
