"""Checks that the modules of a filter compose: no output is overwritten or unused."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

from tensordict import NestedKey

from torch_denkf.filters.structure import Placed, Structure, takes_reading
from torch_denkf.running import marks_of, reads, reads_of, writes
from torch_denkf.submodel import Update, role

__all__ = ["check_composition"]


def check_composition(modules: Sequence[Placed], structure: Structure) -> None:
    """Raises if a filter's modules would lose or overwrite an entry.

    Args:
        modules: in the order in which they were given.
        structure: the same, sorted.

    Raises:
        ValueError: that names the module, the entry, and what to do.
    """
    needed, optional = reads_of(module for _, module in modules)
    read = [*needed, *optional]
    _check_both(read, structure.carry, modules)
    _check_overwriting([*structure.frames, structure.transition, *structure.update])
    _check_nesting(read, [key for _, module in modules for key in writes(module)])
    _check_unread_masks(modules)
    _check_unused(structure.update, [*structure.carry, *structure.belief])


def _check_both(read: Sequence[NestedKey], carry: Sequence[NestedKey], modules: Sequence[Placed]) -> None:
    """Raises if an entry is an input and an output: the next step would read this step's output."""
    for place, module in modules:
        both = [key for key in writes(module) if key in read and key not in carry]
        if both:
            raise ValueError(
                f"{place!r} ({type(module).__name__}) writes {both[0]!r}, which the filter also reads from outside: "
                "the next step would take what this one wrote for a new reading. Write it under another key, and let "
                "the modules behind it read that one; or carry it from step to step: let the initial belief write it."
            )


def _check_unread_masks(modules: Sequence[Placed]) -> None:
    """Raises if a module writes an observed mask that no module reads."""
    read = {key for _, module in modules for key in chain(*reads(module))}
    for place, module in modules:
        for key in marks_of(module):
            if key not in read:
                raise ValueError(
                    f"{place!r} ({type(module).__name__}) marks readings as missing in {key!r}, which no module of the "
                    f"filter reads: give observed_key={key!r} to the filter or its analysis."
                )


def _check_overwriting(modules: Sequence[Placed]) -> None:
    """Raises if all outputs of a module are overwritten before any module has read them."""
    for index, (place, module) in enumerate(modules):
        info = role(module, Update).info_prefix
        unread = {key for key in writes(module) if info is None or key[0] != info}
        used = False
        for other_place, other in modules[index + 1 :]:
            must, may = reads(other)
            used = used or not unread.isdisjoint((*must, *may))
            lost = unread.intersection(writes(other))
            if lost and not used:
                raise ValueError(
                    f"{other_place!r} ({type(other).__name__}) writes {sorted(map(str, lost))} over what {place!r} "
                    f"({type(module).__name__}) wrote, before any module has read it. Give one of them other keys, "
                    "e.g. out_key=, or belief_prefix= of the first analysis and forecast_key= of the second."
                )


def _check_unused(update: Sequence[Placed], belief: Sequence[NestedKey]) -> None:
    """Raises if no module uses the output of an analysis: its reading would have no effect."""
    used = set(belief)
    for place, module in reversed(update):
        info = role(module, Update).info_prefix
        made = [key for key in writes(module) if info is None or key[0] != info]
        if made and takes_reading(module) and used.isdisjoint(made):
            raise ValueError(
                f"{place!r} ({type(module).__name__}) takes in {list(module.reading_keys)} and writes {made}, which no "
                "module behind it reads and which is not the belief: the reading would be lost. The next analysis goes "
                "on from there: give it forecast_key= or forecast_prefix= of that name."
            )
        used.update(chain(*reads(module)))


def _check_nesting(read: Sequence[NestedKey], written: Sequence[NestedKey]) -> None:
    """Raises if the key of a tensor is also the prefix of another entry."""
    names = set(read) | set(written)
    for key in written:
        for length in range(1, 1 if isinstance(key, str) else len(key)):
            outer = key[0] if length == 1 else key[:length]
            if outer in names:
                raise ValueError(f"{outer!r} is a tensor, so that {key!r} cannot be written: rename one of them.")
