"""Readings that cannot be true: not a number, infinite, or absurdly large. They count as not observed.

A reading is rejected where it comes in, in front of the sensors: there its mask is known, and no network sees it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor

from torch_denkf._checks import check_mask
from torch_denkf.submodel import Entries, Update

__all__ = ["LARGEST_READING", "REJECTED", "Guard", "guards_of", "rejected_keys", "usable"]

#: The largest value of a reading, in any unit: squares of larger ones leave float32.
LARGEST_READING = 1e18
_LARGEST = {torch.float16: torch.finfo(torch.float16).max}
#: How many readings a step rejected, ``[*B, 1]``, int64.
REJECTED = ("info", "rejected")


class Guard(NamedTuple):
    """A mask, and the entries from outside that it hides.

    Attributes:
        mask: key of the mask ``[*B, 1]`` or ``[*B, O]``.
        whole: entries of which one bad value hides all.
        components: entries ``[*B, O]``, ``[*B, E, O]`` or ``[*B, O, O]``, of which each component is hidden by itself.
    """

    mask: NestedKey
    whole: tuple[NestedKey, ...]
    components: tuple[NestedKey, ...]


def guards_of(
    parts: Iterable[Update],
    sources: Mapping[NestedKey, Sequence[NestedKey]],
    made_of: Mapping[NestedKey, NestedKey],
) -> tuple[Guard, ...]:
    """A guard for each mask.

    Args:
        parts: sub-models, of which those with ``reading_keys`` and an ``observed_key`` update a belief.
        sources: the entries from outside that each reading is made of.
        made_of: the mask from outside, of a mask that a module makes of it.
    """
    readers: dict[NestedKey, list[Update]] = {}
    for part in parts:
        mask = part.observed_key
        if mask is not None and part.reading_keys:
            mask = unravel_key(mask)
            while mask in made_of:
                mask = made_of[mask]
            readers.setdefault(mask, []).append(part)
    guards = []
    for mask, sharing in readers.items():
        whole: dict[NestedKey, None] = {}
        components: dict[NestedKey, None] = {}
        same = len({_direct(part, sources) for part in sharing}) == 1
        by_component = same and all(part.reads_components for part in sharing)
        for key in (unravel_key(key) for part in sharing for key in part.reading_keys):
            for source in sources.get(key, ()):
                (components if by_component and source == key else whole)[source] = None
        whole = {key: None for key in whole if key not in components}
        guards.append(Guard(mask, tuple(whole), tuple(components)))
    return tuple(guards)


def _direct(part: Update, sources: Mapping[NestedKey, Sequence[NestedKey]]) -> frozenset[NestedKey]:
    """The readings that come from outside as they are; all readings, where a module makes them."""
    keys = [unravel_key(key) for key in part.reading_keys]
    return frozenset([key for key in keys if key in sources.get(key, ())] or keys)


def usable(guards: Sequence[Guard], entries: Entries, batch_size: Sequence[int]) -> Entries:
    """The entries with what is rejected set to zero and hidden by its mask, and the count under :data:`REJECTED`.

    Args:
        guards: of the filter.
        entries: what its modules read.
        batch_size: ``[*B]``, of the entries.
    """
    out, size = dict(entries), len(batch_size)
    device = next((value.device for value in entries.values()), None)
    count = torch.zeros(*batch_size, 1, dtype=torch.int64, device=device)
    good: dict[NestedKey, Tensor] = {}
    for key in (key for guard in guards for key in (*guard.whole, *guard.components)):
        value = entries.get(key)
        if value is not None and value.is_floating_point() and key not in good:
            good[key] = value.abs() <= _LARGEST.get(value.dtype, LARGEST_READING)  # also false for NaN
            out[key] = torch.where(good[key], value, torch.zeros_like(value))
    for guard in guards:
        parts = [good[key].flatten(size).all(-1, keepdim=True) for key in guard.whole if key in good]
        for key in guard.components:
            if key in good:
                parts.append(good[key].flatten(size, -2).all(-2) if good[key].ndim > size + 1 else good[key])
        if not parts:
            continue
        fine = parts[0]
        for part in parts[1:]:
            fine = fine & part
        observed = entries.get(guard.mask)
        if observed is not None:
            _check_mask(guard.mask, observed, batch_size, fine.shape[-1])
        lost = ~fine if observed is None else observed & ~fine
        out[guard.mask] = fine if observed is None else observed & fine
        count = count + lost.sum(-1, keepdim=True)
    out[REJECTED] = count
    return out


def _check_mask(key: NestedKey, mask: Tensor, batch_size: Sequence[int], width: int) -> None:
    """Raises a ``ValueError`` unless a mask is boolean, ``[*B, 1]`` or ``[*B, O]``."""
    check_mask(f"the mask {key!r}", mask)
    widths = {1, mask.shape[-1] if width == 1 and mask.ndim else width}
    if mask.shape[:-1] != tuple(batch_size) or mask.ndim == 0 or mask.shape[-1] not in widths:
        raise ValueError(
            f"the mask {key!r} must be [*B, 1] or [*B, O] with B = {list(batch_size)}; got {list(mask.shape)}"
        )


def rejected_keys(guards: Sequence[Guard], entries: Mapping[NestedKey, Tensor]) -> list[NestedKey]:
    """The readings that :func:`usable` would reject, for a message; not those that a mask hides already."""
    found: dict[NestedKey, None] = {}
    for guard in guards:
        observed = entries.get(guard.mask)
        for key in (*guard.whole, *guard.components):
            value = entries.get(key)
            if value is None or not value.is_floating_point():
                continue
            largest = _LARGEST.get(value.dtype, LARGEST_READING)
            if not value.numel():
                continue
            least, most = value.detach().aminmax()  # in one pass: images are large, and rarely wrong
            if bool((most <= largest) & (least >= -largest)):
                continue
            bad = ~(value.abs() <= largest)
            if observed is not None:
                size = observed.ndim - 1
                seen = observed
                if key not in guard.components or observed.shape[-1] != value.shape[-1]:
                    seen = observed.any(-1, keepdim=True)
                bad = bad & seen.reshape(*observed.shape[:size], *(1,) * (value.ndim - size - 1), seen.shape[-1])
            if bool(bad.any()):
                found[key] = None
    return list(found)
