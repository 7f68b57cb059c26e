"""Raises before a step: entries that are missing or unknown, mixed precision."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key

from torch_denkf.diagnosis.errors import missing_entry
from torch_denkf.filters.structure import Structure, previous_key, takes_reading
from torch_denkf.running import in_sequences, writes
from torch_denkf.submodel import Entries, Sensor, Update, in_role, role

__all__ = [
    "check_inputs",
    "check_actions",
    "check_named_readings",
    "check_joined_readings",
    "check_precision",
    "check_noise",
    "readings_to_leave_out",
]


def check_inputs(
    structure: Structure,
    name: str,
    entries: Entries,
    tensordict: TensorDictBase,
    without: Collection[NestedKey] = (),
    *,
    carry: bool = True,
) -> None:
    """Raises a ``KeyError`` that names the missing entries, the modules that read them, and the given entries.

    Args:
        structure: of the filter.
        name: of the filter's class.
        entries: what was found.
        tensordict: where.
        without: readings that are missing on purpose.
        carry: whether the belief must be there.
    """
    for key in structure.carry if carry else ():
        if key not in entries:
            raise KeyError(
                f"{name} carries its belief in {key!r}, which the tensordict lacks. Call "
                "filter.initialise(tensordict) at the start of an episode; in an environment append "
                "DEnKFTransform(filter), or InitTracker() and filter.make_tensordict_primer() where the filter is "
                "part of the policy."
            )
    missing = []
    for key in (*structure.needed, *structure.required_controls):
        if key not in entries and key not in without and previous_key(key) not in entries:
            missing.append(key)
    if missing:
        readers = [
            type(m).__name__ for _, m in structure.modules if not set(missing).isdisjoint(map(unravel_key, m.in_keys))
        ]
        raise missing_entry(
            ", ".join(readers) or name,
            missing,
            tensordict.keys(True, True),
            "Rename the key in the constructor, or put the module that writes it in front. A reading that is missing "
            "on purpose: step(..., without=[key]), predict(...), or a mask.",
        )


def check_actions(structure: Structure, entries: Entries) -> None:
    """Raises a ``KeyError`` where a step resumes from a policy's belief, and the action before it is not there."""
    missing = [key for key in structure.required_controls if previous_key(key) not in entries]
    if missing:
        raise KeyError(
            f"The belief is that of a policy, one step before, and {missing} drives the step. The action before it is "
            f"missing: {[previous_key(key) for key in missing]}. Put filter.make_tensordict_primer(), which brings it, "
            "into the environment."
        )


def check_noise(places: Collection[str], name: str, noise: Entries) -> None:
    """Raises a ``KeyError`` where noise is given for a place that draws none: it would be ignored."""
    unknown = [key for key in noise if len(key) < 2 or key[1] not in places]
    if unknown:
        raise KeyError(f"{unknown} is noise of no module of {name}; noise is drawn at {sorted(places)}.")


def readings_to_leave_out(structure: Structure, without: Sequence[NestedKey]) -> list[NestedKey]:
    """Returns the keys of readings to leave out, unravelled.

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


def check_named_readings(structure: Structure) -> None:
    """Raises a ``KeyError`` where an analysis takes in a reading and does not say so: ``predict`` could not hide it."""
    frames = {*structure.needed, *structure.frame_keys}
    for place, module in structure.update:
        for part in in_sequences(module):
            read = [key for key in part.in_keys if unravel_key(key) in frames]
            corrects = not set(structure.carry).isdisjoint(writes(part))
            if corrects and read and not takes_reading(part) and not role(part, Update).reading_keys:
                raise KeyError(
                    f"{type(part).__name__} at place {place!r} corrects the belief by {read}, and does not say which "
                    "are readings: predict() cannot leave them out. Let its constructor set self.reading_keys, the "
                    "reading and its noise, and self.observed_key, the mask that it heeds; or call step() with a mask."
                )


def check_joined_readings(structure: Structure, without: Sequence[NestedKey]) -> None:
    """Raises a ``ValueError`` where some readings are to be left out, not all, of those that a module joins."""
    joined = any(part.joins_readings for _, module in structure.modules for part in in_role(module, Sensor))
    if joined and without and set(without) != set(structure.readings):
        raise ValueError(
            f"Where readings are looked at together, step(without={list(without)}) cannot leave out single ones: "
            "hide them with their masks."
        )


def check_precision(filter: torch.nn.Module) -> None:
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
