"""The length of a step: one number for all, or an entry for each."""

from __future__ import annotations

from tensordict import NestedKey
from torch import Tensor

from torch_denkf._checks import check_number

__all__ = ["check_dt", "for_members", "keys_of_dt"]


def keys_of_dt(dt: float | NestedKey) -> list[NestedKey]:
    """Returns the key of the time step, if it is no number."""
    return [] if isinstance(dt, (int, float)) else [dt]


def check_dt(dt: float | NestedKey) -> None:
    """Raises unless a time step is a number that is not negative, or a key.

    Raises:
        ValueError: if it is a negative number.
        TypeError: if it is neither.
    """
    if not isinstance(dt, (str, tuple)):
        check_number("dt", dt, least=0, cure="It is the time step in seconds, or the key of one")
        if not isinstance(dt, (int, float)):
            raise TypeError(
                f"dt must be a number of seconds or a key, got {dt!r} ({type(dt).__name__}); pass float(dt)"
            )


def for_members(dt: float | Tensor) -> float | Tensor:
    """Returns a time step ``[*B, 1]`` as ``[*B, 1, 1]``, next to ensembles ``[*B, E, S]``."""
    return dt.unsqueeze(-2) if isinstance(dt, Tensor) else dt
