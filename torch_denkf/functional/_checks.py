"""Shape checks of this package: the message names the argument and says what to pass."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor


def check_shape(name: str, tensor: Tensor, shape: Sequence[int], layout: str) -> None:
    """Raise unless ``tensor`` has exactly this shape.

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


def check_ensemble(name: str, ensemble: Tensor, min_size: int = 1) -> None:
    """Raise unless ``ensemble`` is ``[*B, E, S]`` with ``E >= min_size``.

    Args:
        name: the argument's name, for the message.
        ensemble: the argument.
        min_size: the fewest members that make sense.

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
