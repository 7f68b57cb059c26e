"""What a step wrote, before a tensordict gets it: is it sound, and in memory of its own?"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from torch_denkf._checks import flag_value, has_values
from torch_denkf.filters.rejection import LARGEST_READING, rejected_keys
from torch_denkf.filters.scan import where_rows
from torch_denkf.filters.structure import Structure
from torch_denkf.submodel import Entries

__all__ = [
    "AbsurdReading",
    "is_finite",
    "masks_in",
    "own",
    "refuse_far_belief",
    "refuse_non_finite",
    "without_absurd_readings",
    "write",
]


class AbsurdReading(ValueError):
    """A reading in a sequence that cannot be true, and that no mask hides; the message names its key."""


def own(written: Entries, given: Iterable[Tensor] = ()) -> Entries:
    """The entries, each in memory of its own: no views, of a filter's constants for example, nothing that was given.

    Args:
        written: what modules wrote.
        given: tensors that the caller keeps.
    """
    if torch.compiler.is_compiling():  # what a graph returns is its own
        return written
    seen, out = set(map(id, given)), {}
    for key, value in written.items():
        out[key] = value.clone() if value._is_view() or id(value) in seen else value
        seen.add(id(value))
    return out


def write(tensordict: TensorDictBase, written: Entries, outer: Callable[[NestedKey], NestedKey] | None = None) -> None:
    """Sets entries, looking up each nested tensordict once; under other names with ``outer``."""
    owners: dict[tuple, Any] = {}
    for key, value in written.items():
        if outer is not None:
            key = outer(key)
        prefix = () if isinstance(key, str) else key[:-1]
        owner = tensordict if not prefix else owners.get(prefix)
        if owner is None:
            owner = tensordict.get(prefix, None) if type(tensordict) is TensorDict else None
        if isinstance(owner, TensorDictBase):
            owners[prefix] = owner
            owner.set(key[-1] if prefix else key, value)
        else:  # not there yet
            tensordict.set(key, value)


#: What to do about a reading that is not finite, behind the masks that could hide it.
_OF_A_STEP = (
    "The tensordict was left as it is. Hide what is broken or missing with a mask ({masks}), or leave it out with "
    "step(..., without=[...]) or predict(...). A filter with reject=True counts such readings as missing; "
    "check_finite=False switches this off."
)


def refuse_non_finite(
    structure: Structure,
    entries: Entries,
    written: Entries,
    reject: bool,
    unread: Tensor | None = None,
    cure: str = _OF_A_STEP,
) -> None:
    """Raises a ``ValueError`` where a reading or the new belief is not finite; the message names the input that is not.

    Args:
        structure: the filter's.
        entries: what the step read.
        written: what it wrote.
        reject: whether readings that are not finite were rejected, and are no mistake.
        unread: rows ``[*B]`` or ``[*B, 1]`` whose readings were not used.
        cure: what the message says to do; ``{masks}`` in it are the masks.
    """
    sound = _is_sound(structure.carry, entries, written)
    if sound is None:
        return
    absurd = [] if reject else rejected_keys(structure.guards, _without_rows(structure, entries, unread))
    if sound and not absurd:
        return
    refuse_far_belief(entries, structure.carry)
    finite = all(is_finite(key, written[key]) for key in structure.carry if key in written)
    if finite and not absurd and all(is_finite(key, entries[key]) for key in structure.carry if key in entries):
        return
    given = {key: value for key, value in entries.items() if value.is_floating_point()}
    bad = [key for key, value in given.items() if not is_finite(key, value)]
    negative = [key for key, value in given.items() if key[-1] in ("cov", "var") and _lowest_variance(key, value) < 0]
    if negative and not bad:
        why = f"negative variances in {negative}"
    elif absurd and not set(absurd) & set(bad):
        why = f"a reading of more than {LARGEST_READING:g} in {absurd}"
    elif bad:
        why = f"NaN or infinity in {bad}"
    else:
        why = "its motion: all inputs are finite, and the filter diverged"
        cure = (
            "Look at the transition's weights and at the noise floor; normalise the state; clip gradients in training. "
            "check_finite=False switches this off."
        )
    state = "to be trusted" if finite else "finite"
    raise ValueError(
        f"The new belief is not {state}, because of {why}. {cure.format(masks=masks_in(structure.optional))}"
    )


def masks_in(optional: Iterable[NestedKey]) -> list[NestedKey]:
    """Of what a filter may read, all but the weights of particles."""
    return [key for key in optional if key[-1] != "log_weight"]


def _is_sound(carry: Sequence[NestedKey], *beliefs: Entries) -> bool | None:
    """Whether beliefs are finite and not far, looked at once; ``None`` where there are no values, as in vmap."""
    sound = None
    for key in carry:
        for belief in beliefs:
            value = belief.get(key)
            if value is not None and value.is_floating_point():
                fine = ((value if key[-1] == "log_weight" else value.abs()) <= LARGEST_READING).all()
                sound = fine if sound is None else sound & fine
    return True if sound is None else flag_value(sound)


def _without_rows(structure: Structure, entries: Entries, rows: Tensor | None) -> Entries:
    """The entries, with zeros in place of the readings of some rows; ``None`` for none."""
    if rows is None:
        return entries
    keys = {key for guard in structure.guards for key in (*guard.whole, *guard.components) if key in entries}
    return {**entries, **{key: where_rows(rows, torch.zeros_like(entries[key]), entries[key]) for key in keys}}


def refuse_far_belief(entries: Mapping[NestedKey, Tensor], keys: Collection[NestedKey]) -> None:
    """Raises a ``ValueError`` where a belief that is given has numbers whose squares leave float32.

    Log-weights may: such a particle has none.
    """
    far = [key for key in keys if key in entries and key[-1] != "log_weight" and _is_far(entries[key])]
    if far:
        raise ValueError(
            f"The belief has numbers of more than {LARGEST_READING:g} in {far}, with which no filter computes. Start "
            "from filter.initialise(), and choose units in which the state is smaller. If the filter came there by "
            "itself, it diverged. check_finite=False switches this off."
        )


def _is_far(value: Tensor) -> bool:
    if not value.is_floating_point() or not has_values(value):
        return False
    return bool(((value.abs() > LARGEST_READING) & value.isfinite()).any())


def _lowest_variance(key: NestedKey, value: Tensor) -> float:
    variance = value.diagonal(dim1=-2, dim2=-1) if key[-1] == "cov" and value.ndim > 1 else value
    return float(variance.min()) if variance.numel() else 0.0


def is_finite(key: NestedKey, value: Tensor) -> bool:
    """Whether an entry of a belief is finite; -inf is the log-weight of a particle that is out of the question."""
    return bool((value < torch.inf).all()) if key[-1] == "log_weight" else bool(value.isfinite().all())


def without_absurd_readings(structure: Structure, entries: Entries, unread: Tensor | None) -> Entries:
    """The entries of a sequence; with zeros for readings that nothing uses, where these are not finite.

    Args:
        structure: the filter's.
        entries: of the sequence ``[*B, T]``.
        unread: elements ``[*B, T, 1]`` whose readings are not used; ``None`` for none.

    Raises:
        AbsurdReading: if readings are not finite, or absurdly large, and not masked.
    """
    looked_at = [key for guard in structure.guards for key in (guard.mask, *guard.whole, *guard.components)]
    if not all(has_values(entries[key]) for key in looked_at if key in entries):
        return entries
    absurd = rejected_keys(structure.guards, entries)
    if absurd and unread is not None:
        entries = _without_rows(structure, entries, unread)
        absurd = rejected_keys(structure.guards, entries)
    if absurd:
        raise AbsurdReading(
            f"There is NaN, infinity or more than {LARGEST_READING:g} in {absurd}, and no mask hides it. Give one "
            f"({masks_in(structure.optional)}), or pass reject=True to the filter, which counts such readings as "
            "missing; check_finite=False switches this off."
        )
    return entries
