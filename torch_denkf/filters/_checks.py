"""What a filter refuses, and what it says: missing entries, beliefs that are not finite, mixed precision."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor

from torch_denkf._checks import flag_value, has_values
from torch_denkf.filters._rejection import LARGEST_READING, rejected_keys
from torch_denkf.filters._steps import where_rows
from torch_denkf.filters._structure import Structure, previous_key, submodels
from torch_denkf.modules._call import Entries
from torch_denkf.modules._running import random_parts

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = [
    "AbsurdReading",
    "check_inputs",
    "is_finite",
    "refuse_absurd_readings",
    "refuse_far_belief",
    "refuse_non_finite",
    "refuse_single_readings",
    "refuse_two_precisions",
    "refuse_unguarded",
    "refuse_unknown_noise",
    "refuse_unknown_readings",
]


class AbsurdReading(ValueError):
    """A reading in a sequence that cannot be true, and that no mask hides; the message names its key."""


def check_inputs(
    filter: Filter,
    entries: Entries,
    tensordict: TensorDictBase,
    without: Collection[NestedKey] = (),
    *,
    carry: bool = True,
) -> None:
    """Raises a ``KeyError`` that names what the modules miss, who reads it, and what is there.

    Args:
        filter: the filter.
        entries: what was found.
        tensordict: where.
        without: readings that are missing on purpose.
        carry: whether the belief must be there.
    """
    structure, name = filter.structure, type(filter).__name__
    for key in structure.carry if carry else ():
        if key not in entries:
            raise KeyError(
                f"{name} carries its belief in {key!r}, which the tensordict lacks. Call "
                "filter.initialise(tensordict) at the start of an episode; in an environment append "
                "DEnKFTransform(filter), or InitTracker() and filter.make_tensordict_primer() where the filter is "
                "part of the policy."
            )
    missing = [
        key
        for key in (*structure.needed, *structure.required_controls)
        if key not in entries and key not in without and previous_key(key) not in entries
    ]
    if missing:
        readers = [
            type(m).__name__ for _, m in structure.modules if not set(missing).isdisjoint(map(unravel_key, m.in_keys))
        ]
        present = ", ".join(sorted(map(str, tensordict.keys(True, True)))) or "nothing"
        raise KeyError(
            f"{', '.join(readers) or name} reads {', '.join(map(repr, missing))}, which the tensordict lacks. It holds "
            f"{present}. Rename the key in the constructor, or put the module that writes it in front. A reading that "
            "is missing on purpose: step(..., without=[key]), predict(...), or a mask."
        )


def refuse_unguarded(structure: Structure, name: str) -> None:
    """Raises a ``ValueError`` where readings are to be rejected, and one cannot be hidden."""
    for place, module in structure.unmasked:
        raise ValueError(
            f"{name} is to reject readings that cannot be true, and {type(module).__name__} at place {place!r} reads "
            'no mask that could hide one: name it in optional_keys=["observed"], and say self.observed_key = '
            '"observed".'
        )
    guarded = {key for guard in structure.guards for key in (*guard.whole, *guard.components)}
    for key in structure.readings:
        if key not in guarded:
            readers = [type(part).__name__ for part in structure.readers(key)]
            raise ValueError(
                f"{name} is to reject readings that cannot be true, and {', '.join(readers)} does not say which entry "
                f'is the mask of {key!r}: self.observed_key = "observed", for example.'
            )


def refuse_non_finite(
    structure: Structure, entries: Entries, written: Entries, reject: bool, unread: Tensor | None = None
) -> None:
    """Raises a ``ValueError`` where a reading or the new belief is not finite; the message names the input that is not.

    Args:
        structure: the filter's.
        entries: what the step read.
        written: what it wrote.
        reject: whether readings that are not finite were rejected, and are no mistake.
        unread: rows ``[*B]`` or ``[*B, 1]`` whose readings were not used.
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
    else:
        why = f"NaN or infinity in {bad}" if bad else "a divergence: all inputs are finite"
    state = "to be trusted" if finite else "finite"
    raise ValueError(
        f"The new belief is not {state}, because of {why}. The tensordict was left as it is. Hide what is broken or "
        f"missing with a mask ({masks_in(structure.optional)}), or leave it out with step(..., without=[...]) or "
        "predict(...). A filter with reject=True counts such readings as missing; check_finite=False switches this off."
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
    """The entries, with zeros in place of the readings of some rows."""
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


def refuse_absurd_readings(structure: Structure, entries: Entries) -> None:
    """Raises :class:`AbsurdReading` where readings of a sequence are not finite, or absurdly large, and not masked."""
    looked_at = [key for guard in structure.guards for key in (guard.mask, *guard.whole, *guard.components)]
    if not all(has_values(entries[key]) for key in looked_at if key in entries):
        return
    absurd = rejected_keys(structure.guards, entries)
    if absurd:
        raise AbsurdReading(
            f"There is NaN, infinity or more than {LARGEST_READING:g} in {absurd}, and no mask hides it. Give one "
            f"({list(structure.optional)}), or pass reject=True to the filter, which counts such readings as missing; "
            "check_finite=False switches this off."
        )


def refuse_missing_actions(structure: Structure, entries: Entries, resumed: bool) -> None:
    """Raises a ``KeyError`` where a step resumes from a policy's belief, and the action before it is not there."""
    missing = [key for key in structure.required_controls if previous_key(key) not in entries]
    if resumed and missing:
        raise KeyError(
            f"The belief is that of a policy, one step before, and {missing} drives the step. The action before it is "
            f"missing: {[previous_key(key) for key in missing]}. Put filter.make_tensordict_primer(), which brings it, "
            "into the environment."
        )


def refuse_unknown_noise(filter: Filter, noise: Entries) -> None:
    """Raises a ``KeyError`` where noise is given for a place that draws none: it would be ignored."""
    structure = filter.structure
    modules = (*structure.modules, ("initial", filter.initial))
    places = {place for name, module in modules for place, _ in random_parts(module, name)}
    unknown = [key for key in noise if len(key) < 2 or key[1] not in places]
    if unknown:
        raise KeyError(
            f"{unknown} is noise of no module of {type(filter).__name__}; noise is drawn at {sorted(places)}."
        )


def refuse_unknown_readings(structure: Structure, without: Sequence[NestedKey]) -> list[NestedKey]:
    """The readings to leave out, unravelled.

    Raises:
        KeyError: if no module reads one of them.
        TypeError: if it is a string and no list of them.
    """
    if isinstance(without, str):
        raise TypeError(f"without is a list of keys: [{without!r}].")
    keys = [unravel_key(key) for key in without]
    unknown = [key for key in keys if key not in structure.needed]
    if unknown:
        raise KeyError(f"without names {unknown}, which no module must find; they read {list(structure.needed)}.")
    return keys


def refuse_single_readings(structure: Structure, without: Sequence[NestedKey]) -> None:
    """Raises a ``ValueError`` where some readings are to be left out, not all, of those that a module joins."""
    joined = any(part.joins_readings for _, module in structure.modules for part in submodels(module))
    if joined and without and set(without) != set(structure.readings):
        raise ValueError(
            f"Where readings are looked at together, step(without={list(without)}) cannot leave out single ones: "
            "hide them with their masks."
        )


def refuse_two_precisions(filter: Filter) -> None:
    """Raises a ``TypeError`` where parameters or constants are of float32 and float64."""
    named = [*filter.named_parameters(), *filter.named_buffers()]
    doubles = [name for name, value in named if value.dtype == torch.float64]
    singles = [name for name, value in named if value.dtype == torch.float32]
    if doubles and singles:
        raise TypeError(
            f"The parts of a filter compute in one precision; {', '.join(doubles[:5])} is float64 and "
            f"{', '.join(singles[:5])} float32. Convert what you passed in with .float(), or build everything under "
            "torch.set_default_dtype(torch.float64)."
        )
