"""Sorts a filter's modules by their keys: those that read only frames, those that read the belief, and the carry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import NamedTuple, TypeGuard

from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf.beliefs import Belief, complete, kinds_of, summary_keys
from torch_denkf.functional.manifolds import Space
from torch_denkf.running import in_sequences, reads, reads_of, writes
from torch_denkf.submodel import Entries, Initial, Update, in_role, role

__all__ = ["HAS_PREVIOUS", "FROM_STORED", "Placed", "Structure", "previous_key"]

#: A module and its place in the filter, which names its noise.
Placed = tuple[str, TensorDictModuleBase]

#: Key of a flag: a policy has a belief before this element.
HAS_PREVIOUS = ("previous", "known")
#: Key of a flag: an element of a sequence starts from the stored belief before it.
FROM_STORED = ("previous", "resumes")


def previous_key(key: NestedKey) -> tuple[str, ...]:
    """Returns the key of the previous step's value in a policy's data."""
    return ("previous", key) if isinstance(key, str) else ("previous", *key)


def takes_reading(module: TensorDictModuleBase) -> TypeGuard[Update]:
    """Tells whether a module is an update with a reading and an observed mask."""
    return isinstance(module, Update) and bool(module.reading_keys) and module.observed_key is not None


class Structure(NamedTuple):
    """A filter's modules in order, sorted by their inputs.

    Attributes:
        initial: the initial belief.
        frames: modules that read frames, and not the belief.
        transition: the module that forecasts the carry: the first that depends on the belief.
        update: the modules between the forecast and the belief, and those that depend only on the action.
        posterior: ``update``, then the ceiling of variances.
        needed: required keys in addition to the carry and the controls.
        must: all required keys of a step.
        optional: optional keys.
        controls: keys that drive the transition.
        required_controls: the required ones of them.
        carry: keys of the belief that continue from step to step.
        carried: the same, each with the kind of belief that has its own test for finite values, or ``None``.
        belief: keys of the belief: the carry, and entries computed from it.
        forecast_of: the forecast of each carried entry, if the transition writes one.
        beside: other outputs of the transition.
        readings: raw entries from which the analyses' readings are computed.
        own_info: new names for diagnostics that several analyses would write under the same key.
        totals: sums of these diagnostics over the analyses.
        space: space of the state; ``None`` for plain numbers.
        kinds: kinds of the belief, one for each prefix.
        likelihoods: the log-likelihood of each analysis' reading.
        frame_keys: outputs of the frame modules.
        step_keys: outputs of transition and update.
    """

    initial: TensorDictModuleBase
    frames: tuple[Placed, ...]
    transition: Placed
    update: tuple[Placed, ...]
    posterior: tuple[Placed, ...]
    needed: tuple[NestedKey, ...]
    must: frozenset[NestedKey]
    optional: tuple[NestedKey, ...]
    controls: tuple[NestedKey, ...]
    required_controls: tuple[NestedKey, ...]
    carry: tuple[NestedKey, ...]
    carried: tuple[tuple[NestedKey, Belief | None], ...]
    belief: tuple[NestedKey, ...]
    forecast_of: dict[NestedKey, NestedKey]
    beside: tuple[NestedKey, ...]
    readings: tuple[NestedKey, ...]
    own_info: dict[str, dict[NestedKey, NestedKey]]
    totals: dict[NestedKey, tuple[NestedKey, ...]]
    space: Space | None
    kinds: tuple[Belief, ...]
    likelihoods: tuple[NestedKey, ...]
    frame_keys: tuple[NestedKey, ...]
    step_keys: tuple[NestedKey, ...]

    @property
    def modules(self) -> tuple[Placed, ...]:
        """Returns all modules, in the order in which they run."""
        return (*self.frames, self.transition, *self.update)

    def in_keys(self, init_key: NestedKey) -> list[NestedKey]:
        """Returns all inputs of a filter, including stored beliefs, inputs in a policy, and the marks of resets."""
        keys = [*self.needed, *self.controls, *self.carry, *map(previous_key, self.carry), HAS_PREVIOUS]
        keys += [*map(previous_key, self.controls), *self.belief, init_key, *self.optional]
        return list(dict.fromkeys(keys))

    @property
    def out_keys(self) -> list[NestedKey]:
        """Returns all outputs of a filter."""
        return [*self.frame_keys, *self.step_keys]

    def completed(self, entries: Entries, stored: Entries | None = None) -> Entries:
        """Returns a belief with the entries computed from its carry, see :func:`torch_denkf.beliefs.complete`."""
        lacking = any(key not in entries for key in self.belief)
        further = role(self.initial, Initial).derived({**(stored or {}), **entries}) if lacking else {}
        return complete({**further, **entries}, self.belief, self.kinds, stored)

    @classmethod
    def of(
        cls,
        modules: Sequence[Placed],
        initial: TensorDictModuleBase,
        control_keys: Sequence[NestedKey],
        forecast_keys: Mapping[NestedKey, NestedKey],
    ) -> Structure:
        """Sorts modules.

        Raises:
            ValueError: if no module depends on the initial belief, one module would overwrite another, or the forecast
                is ambiguous.
        """
        provided = [unravel_key(key) for key in initial.out_keys]
        needed, optional = reads_of(module for _, module in modules)
        carry = [key for key in (*needed, *optional) if key in provided]
        if not carry:
            raise ValueError(
                f"No module of the filter reads an output of its initial belief ({provided}); the filter reads "
                f"{needed}. Give both the same keys."
            )
        frames, steps = _sorted(modules, carry, control_keys)
        own_info, totals = _apart(steps)
        renamed = {name for names in own_info.values() for name in names.values()}
        needed, optional = ([key for key in keys if key not in renamed] for keys in (needed, optional))
        written = [own_info.get(place, {}).get(key, key) for place, module in steps for key in writes(module)]
        step_keys = tuple(dict.fromkeys([*written, *totals]))
        still = [key for key in carry if key not in step_keys]
        if still:
            raise ValueError(
                f"The belief has {still}, which no module writes, so that a step would lose it. Let a module write it."
            )
        belief = list(dict.fromkeys([*(key for key in provided if key in step_keys), *summary_keys(carry, step_keys)]))
        space = role(initial, Initial).space
        kinds = kinds_of(belief, space, carry)
        forecast_of = _forecasts(carry, writes(steps[0][1]), forecast_keys)
        _check_forecasts(forecast_of, kinds)
        return cls(
            initial=initial,
            frames=tuple(frames),
            transition=steps[0],
            update=tuple(steps[1:]),
            posterior=tuple(steps[1:]),
            needed=tuple(key for key in needed if key not in carry and key not in control_keys),
            must=frozenset([*needed, *carry]),
            optional=tuple(key for key in optional if key not in carry and key not in control_keys),
            controls=tuple(key for key in (*needed, *optional) if key in control_keys),
            required_controls=tuple(key for key in needed if key in control_keys),
            carry=tuple(carry),
            carried=tuple((key, _judge_of(key, kinds)) for key in carry),
            belief=tuple(belief),
            forecast_of=forecast_of,
            beside=tuple(key for key in writes(steps[0][1]) if key not in forecast_of.values()),
            readings=tuple(_readings(frames, steps[1:], needed)),
            own_info=own_info,
            totals=totals,
            space=space,
            kinds=kinds,
            likelihoods=tuple(_likelihoods(steps, own_info, totals)),
            frame_keys=tuple(dict.fromkeys(key for _, module in frames for key in writes(module))),
            step_keys=step_keys,
        )


def _judge_of(key: NestedKey, kinds: Sequence[Belief]) -> Belief | None:
    """Returns the kind of belief that has its own ``finite`` for an entry."""
    return next((kind for kind in kinds if key in kind.carry and type(kind).finite is not Belief.finite), None)


def _sorted(
    modules: Sequence[Placed], carry: Sequence[NestedKey], controls: Sequence[NestedKey]
) -> tuple[list[Placed], list[Placed]]:
    """Returns the modules that read only frames; and the others, the transition first.

    A module that depends on the action and not on the belief, such as a reading's noise, runs after the transition. So
    does a module that only carries its own entries, such as a count.
    """
    frames: list[Placed] = []
    driven: list[Placed] = []
    steps: list[Placed] = []
    on_action, on_belief = set(controls), set(carry)
    for place, module in modules:
        read = {*chain(*reads(module))}
        if not steps and not on_belief.isdisjoint(read) and set(writes(module)) <= set(carry):
            driven.append((place, module))
        elif not on_belief.isdisjoint(read):
            steps.append((place, module))
            on_belief.update(writes(module))
        elif not on_action.isdisjoint(read):
            (steps if steps else driven).append((place, module))
            on_action.update(writes(module))
        else:
            frames.append((place, module))
    if not steps:  # the first that reads the belief forecasts it, in place
        first = next(
            index for index, (_, module) in enumerate(driven) if not {*carry}.isdisjoint(chain(*reads(module)))
        )
        steps.append(driven.pop(first))
    made = {key: place for place, module in driven for key in writes(module) if key not in carry}
    for key in chain(*reads(steps[0][1])):
        if key in made:
            raise ValueError(
                f"{steps[0][0]!r} forecasts the belief and reads {key!r}, which {made[key]!r} computes from the action "
                "only. Let the transition read the action itself, or put both into one module."
            )
    return frames, [*steps[:1], *driven, *steps[1:]]


def _forecasts(
    carry: Sequence[NestedKey], written: Sequence[NestedKey], chosen: Mapping[NestedKey, NestedKey]
) -> dict[NestedKey, NestedKey]:
    """Maps each carried entry to its forecast, the output of the transition with the same last name."""
    chosen = {unravel_key(key): unravel_key(value) for key, value in chosen.items()}
    unknown = [key for key in chosen if key not in carry] + [key for key in chosen.values() if key not in written]
    if unknown:
        raise ValueError(
            f"forecast_keys has {unknown}; it carries {list(carry)}, the transition writes {list(written)}."
        )
    found = {}
    for key in carry:
        name = key if isinstance(key, str) else key[-1]
        same = [other for other in written if (other if isinstance(other, str) else other[-1]) == name and other != key]
        if key in chosen:
            found[key] = chosen[key]
        elif len(same) == 1:
            found[key] = same[0]
        elif len(same) > 1:
            raise ValueError(f"The transition writes {same}; select the forecast: forecast_keys={{{key!r}: ...}}.")
    if not found:
        if len(carry) > 1 or len(written) > 1:
            raise ValueError(
                f"The first module that reads the belief, {list(carry)}, writes {list(written)}, of which none is a "
                "forecast by its name. Select it: forecast_keys={carried: forecast}."
            )
        found[carry[0]] = written[0]
    return found


def _check_forecasts(forecast_of: Mapping[NestedKey, NestedKey], kinds: Sequence[Belief]) -> None:
    """Raises if the transition forecasts some entries of a belief and the forecasts of the others are ambiguous."""
    for kind in kinds:
        lacking = [key for key in kind.carry if key not in forecast_of]
        if lacking and len(lacking) < len(kind.carry):
            raise ValueError(
                f"The transition writes no forecast of {lacking} under the same last name: select the entry, "
                f"forecast_keys={{{lacking[0]!r}: ...}}."
            )


def _readings(frames: Sequence[Placed], update: Sequence[Placed], needed: Sequence[NestedKey]) -> list[NestedKey]:
    """Returns the external entries from which the analyses' readings are computed, through any sensors."""
    found: dict[NestedKey, None] = {}
    for _, module in update:
        for part in in_role(module, Update):
            found.update(dict.fromkeys(map(unravel_key, part.reading_keys)))
    for _, module in reversed([*frames, *update]):
        if not found.keys().isdisjoint(writes(module)):
            found.update(dict.fromkeys(reads(module)[0]))
    made_by_steps = {key for _, module in update for key in writes(module)}
    return [key for key in found if key in needed and key not in made_by_steps]


def _apart(steps: Sequence[Placed]) -> tuple[dict[str, dict[NestedKey, NestedKey]], dict]:
    """Returns distinct names for the diagnostics of several analyses, and the entries to sum."""
    writers: dict[str, list[Placed]] = {}
    for place, module in steps:
        for part in in_sequences(module):
            info = role(part, Update).info_prefix
            if info is not None:
                writers.setdefault(info, []).append((place, part))
    own_info: dict[str, dict[NestedKey, NestedKey]] = {}
    totals: dict[NestedKey, list[NestedKey]] = {}
    for info, placed in writers.items():
        if len(placed) < 2:
            continue
        inside = [place for place, module in placed if (place, module) not in steps]
        if inside:
            raise ValueError(
                f"Several analyses write their diagnostics under {info!r}, and in the sequence {inside[0]!r} they "
                "would be overwritten: give each its own info_prefix."
            )
        for place, module in placed:
            own_info[place] = {key: (info, place, *key[1:]) for key in writes(module) if key[0] == info}
            for key in ((info, "nis"), (info, "log_likelihood")):
                if key in own_info[place]:
                    totals.setdefault(key, []).append(own_info[place][key])
    return own_info, {key: tuple(values) for key, values in totals.items()}


def _likelihoods(steps: Sequence[Placed], own_info: Mapping, totals: Mapping) -> list[NestedKey]:
    """Returns the log-likelihoods whose sum is that of all readings."""
    found = []
    for place, module in steps:
        for part in in_sequences(module):
            key = (role(part, Update).info_prefix, "log_likelihood")
            if key in writes(part):
                found.append(key if key in totals else own_info.get(place, {}).get(key, key))
    return list(dict.fromkeys(found))
