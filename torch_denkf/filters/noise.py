"""The noise of all modules of a filter, drawn in bulk: for a whole sequence at once, or in front of a compiled step."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import torch
from tensordict import unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from torch_denkf.filters.structure import Placed, Structure
from torch_denkf.running import random_parts
from torch_denkf.submodel import Entries, Initial, SubModel, Update, flat_noise, role

__all__ = ["draw_noise"]


def draw_noise(
    structure: Structure,
    initial: TensorDictModuleBase,
    entries: Entries,
    batch_size: torch.Size,
    modules: Iterable[Placed],
    *,
    like: Tensor | None = None,
    time: bool = False,
    generator: torch.Generator | None = None,
    say_eager: Callable[[str, str], None] | None = None,
) -> tuple[Entries, bool]:
    """The noise of ``modules`` that is not among the entries.

    Args:
        structure: of the filter that they are of.
        initial: its initial belief.
        entries: what is known of the step: the carry and the frames' outputs tell sizes.
        batch_size: ``[*B]``, or ``[*B, T]``.
        modules: with their places.
        like: has the filter's precision.
        time: whether the last of ``batch_size`` is time.
        generator: source of randomness; torch's global one by default.
        say_eager: told why a noise could not be drawn, and what to do.

    Returns:
        The noise, as far as its size is known before the step; and whether that is all.
    """
    parts = [found for place, module in modules for found in random_parts(module, place)]
    drawn: Entries = {}
    if not parts:
        return drawn, True
    complete = True
    device = next((value.device for value in entries.values()), None if like is None else like.device)
    dtype = None if like is None else like.dtype
    members, state_dim = _sizes(structure, initial, entries)
    for place, part in parts:
        keys = [("noise", place, name) if name else ("noise", place) for name in part.noise_names]
        if not all(key in entries for key in keys):
            noise = part.draw_noise(
                batch_size,
                members=members,
                state_dim=state_dim,
                observation_dim=_observation_dim(structure, part, entries),
                time=time,
                device=device,
                dtype=dtype,
                generator=generator,
            )
            if noise is None:
                complete = False
                if say_eager is not None:
                    say_eager(*_undrawn(place, part))
            drawn.update(flat_noise(noise, place))
    return drawn, complete


def _sizes(structure: Structure, initial: TensorDictModuleBase, entries: Entries) -> tuple[int | None, int | None]:
    """E and S of the belief."""
    for key in structure.carry:
        if key[-1] == "ensemble" and key in entries:
            members, state_dim = entries[key].shape[-2:]
            return members, state_dim
    told = role(initial, Initial)
    return told.ensemble_size, told.state_dim


def _observation_dim(structure: Structure, part: SubModel, entries: Entries) -> int | None:
    """O of the reading that a sub-model uses: from the entry, or from the module that writes it.

    A sub-model that does not name the entry of its variances is told where all that is known of what it reads agrees.
    """
    known = structure.observation_dims
    key = role(part, Update).noise_variance_key
    if key is not None:
        return entries[key].shape[-1] if key in entries else known.get(key)
    found = {known[key] for key in map(unravel_key, part.in_keys) if key in known}
    found |= {entries[key].shape[-1] for key in map(unravel_key, role(part, Update).reading_keys) if key in entries}
    return found.pop() if len(found) == 1 else None


def _undrawn(place: str, part: SubModel) -> tuple[str, str]:
    """Why a noise could not be drawn before the step, and what to do."""
    name = type(part).__name__
    return (
        f"{name} at place {place!r} cannot draw its noise before the step.",
        f"Its draw_noise() must return a tensor from members=, state_dim= and observation_dim=; where {name} needs "
        "observation_dim, let its attribute noise_variance_key name the entry that holds the variances of its reading.",
    )
