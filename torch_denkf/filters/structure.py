"""What a filter's modules say about themselves: who reads frames alone, who the belief, and what is carried on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain
from typing import NamedTuple, TypeGuard, TypeVar

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase, TensorDictSequential

from torch_denkf.filters.rejection import Guard, guards_of
from torch_denkf.functional.manifolds import Space
from torch_denkf.running import (
    in_sequences,
    is_sequence,
    marks_of,
    named_modules_of,
    reads,
    reads_of,
    writes,
)
from torch_denkf.submodel import Initial, Sensor, SubModel, Update, role

__all__ = ["KNOWN", "RESUMES", "Placed", "Structure", "in_role", "previous_key", "sequences_in", "submodels"]

#: A module and its place in the filter, which names its noise.
Placed = tuple[str, TensorDictModuleBase]

#: Whether a policy has a belief before this element.
KNOWN = ("previous", "known")
#: Whether an element of a sequence begins with the belief that is stored before it.
RESUMES = ("previous", "resumes")
_SUMMARIES = ("mean", "var", "cov")
R = TypeVar("R", bound=SubModel)


def previous_key(key: NestedKey) -> tuple[str, ...]:
    """Where a policy's filter finds what was ``key`` one step before."""
    return ("previous", key) if isinstance(key, str) else ("previous", *key)


def submodels(module: torch.nn.Module) -> list[SubModel]:
    """Returns the sub-models inside ``module``, also those inside others."""
    return in_role(module, SubModel)


def in_role(module: torch.nn.Module, kind: type[R]) -> list[R]:
    """Returns the sub-models of a role inside ``module``, also those inside others."""
    return [part for part in module.modules() if isinstance(part, kind)]


def takes_reading(module: TensorDictModuleBase) -> TypeGuard[Update]:
    """Whether a module takes in a reading, and heeds a mask that hides it."""
    return isinstance(module, Update) and bool(module.reading_keys) and module.observed_key is not None


def sequences_in(sequence: TensorDictSequential) -> Iterator[TensorDictSequential]:
    """A filter, and the plain sequences inside it."""
    yield sequence
    for _, module in named_modules_of(sequence):
        if is_sequence(module):
            yield from sequences_in(module)


class Structure(NamedTuple):
    """A filter's modules in their order, sorted by what they read.

    Attributes:
        frames: modules that read frames alone, and not the belief.
        transition: the module that forecasts the carry: the first that depends on the belief.
        update: the modules between the forecast and the belief, and those that depend on the action alone.
        needed: keys that must be there beside the carry and the controls.
        optional: keys that are used where they are there.
        controls: keys that drive the transition.
        required_controls: those of them that must be there.
        carry: keys of the belief that go on from step to step.
        belief: keys of the belief; the carry, and what follows from it.
        forecast_of: the forecast of each carried entry, as far as the transition writes one.
        beside: what else the transition writes.
        observation_dims: O of each entry that a noise module of the update writes, as far as it is known.
        readings: raw entries that the analyses' readings are made of.
        plain: those of them that an analysis reads itself.
        guards: what a mask hides, of those readings.
        unmasked: modules of the update that take in a reading and read no mask.
        own_info: new names for diagnostics that several analyses would write under one.
        totals: sums of those over the analyses.
        space: in which the state lives; ``None`` for plain numbers.
        likelihoods: the log-likelihood of each analysis' reading.
        frame_keys: what the frame modules write.
        step_keys: what transition and update write.
    """

    frames: tuple[Placed, ...]
    transition: Placed
    update: tuple[Placed, ...]
    needed: tuple[NestedKey, ...]
    optional: tuple[NestedKey, ...]
    controls: tuple[NestedKey, ...]
    required_controls: tuple[NestedKey, ...]
    carry: tuple[NestedKey, ...]
    belief: tuple[NestedKey, ...]
    forecast_of: dict[NestedKey, NestedKey]
    beside: tuple[NestedKey, ...]
    observation_dims: dict[NestedKey, int]
    readings: tuple[NestedKey, ...]
    plain: tuple[NestedKey, ...]
    guards: tuple[Guard, ...]
    unmasked: tuple[Placed, ...]
    own_info: dict[str, dict[NestedKey, NestedKey]]
    totals: dict[NestedKey, tuple[NestedKey, ...]]
    space: Space | None
    likelihoods: tuple[NestedKey, ...]
    frame_keys: tuple[NestedKey, ...]
    step_keys: tuple[NestedKey, ...]

    @property
    def modules(self) -> tuple[Placed, ...]:
        """All modules, in the order in which they run."""
        return (*self.frames, self.transition, *self.update)

    def readers(self, key: NestedKey) -> list[TensorDictModuleBase]:
        """The sub-models of the update that take in a reading that is made of the entry ``key``."""
        parts = [part for _, module in self.update for part in in_role(module, Update)]
        direct = [part for part in parts if key in map(unravel_key, part.reading_keys)]
        return direct or [part for part in parts if part.reading_keys]

    def lost(self, missing: Iterable[NestedKey]) -> frozenset[NestedKey]:
        """Without some entries, what is not there: they, and all that is made of them up to an analysis."""
        lost, written = set(missing), set()
        for _, module in self.modules:
            for part in in_sequences(module):
                if lost.isdisjoint(part.in_keys) or takes_reading(part):
                    written.update(writes(part))
                else:  # an entry that another module wrote before stays
                    lost.update(key for key in writes(part) if key not in written)
        return frozenset(lost)

    def in_keys(self, init_key: NestedKey) -> list[NestedKey]:
        """All that a filter reads: also stored beliefs, those of a policy, and what marks a beginning."""
        keys = [*self.needed, *self.controls, *self.carry, *map(previous_key, self.carry), KNOWN]
        keys += [*map(previous_key, self.controls), *self.belief, init_key, *self.optional]
        return list(dict.fromkeys(keys))

    @property
    def out_keys(self) -> list[NestedKey]:
        """All that a filter writes."""
        return [*self.frame_keys, *self.step_keys]

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
            ValueError: if no module depends on the initial belief, one module would undo another, or it is not clear
                what the forecast is.
        """
        provided = [unravel_key(key) for key in initial.out_keys]
        needed, optional = reads_of(module for _, module in modules)
        carry = [key for key in (*needed, *optional) if key in provided]
        if not carry:
            raise ValueError(
                f"No module of the filter reads what its initial belief writes ({provided}); the filter reads "
                f"{needed}. Give both the same keys."
            )
        _refuse_both([*needed, *optional], carry, modules)
        frames, steps = _sorted(modules, carry, control_keys)
        _refuse_overwriting([*frames, *steps])
        _refuse_nesting([*needed, *optional], [key for _, module in modules for key in writes(module)])
        _refuse_unread_masks(modules)
        own_info, totals = _apart(steps)
        renamed = {name for names in own_info.values() for name in names.values()}
        needed, optional = ([key for key in keys if key not in renamed] for keys in (needed, optional))
        written = [own_info.get(place, {}).get(key, key) for place, module in steps for key in writes(module)]
        step_keys = tuple(dict.fromkeys([*written, *totals]))
        still = [key for key in carry if key not in step_keys]
        if still:
            raise ValueError(
                f"The belief holds {still}, which no module writes: a step would lose it. Let one pass it on."
            )
        belief = [key for key in provided if key in step_keys]
        for key in step_keys:  # a summary that the analysis writes and the initial belief does not
            if key not in belief and key[-1] in _SUMMARIES and any(key[:-1] == other[:-1] for other in carry):
                belief.append(key)
        _refuse_unused(steps, [*carry, *belief])
        forecast_of = _forecasts(carry, writes(steps[0][1]), forecast_keys)
        return cls(
            frames=tuple(frames),
            transition=steps[0],
            update=tuple(steps[1:]),
            needed=tuple(key for key in needed if key not in carry and key not in control_keys),
            optional=tuple(key for key in optional if key not in carry and key not in control_keys),
            controls=tuple(key for key in (*needed, *optional) if key in control_keys),
            required_controls=tuple(key for key in needed if key in control_keys),
            carry=tuple(carry),
            belief=tuple(belief),
            forecast_of=forecast_of,
            beside=tuple(key for key in writes(steps[0][1]) if key not in forecast_of.values()),
            observation_dims=_observation_dims([*frames, *steps[1:]]),
            readings=tuple(_readings(frames, steps[1:], needed)),
            plain=tuple(_plain(steps[1:], needed)),
            guards=_guards(frames, steps[1:], needed, initial),
            unmasked=tuple(_unmasked(steps, carry)),
            own_info=own_info,
            totals=totals,
            space=role(initial, Initial).space,
            likelihoods=tuple(_likelihoods(steps, own_info, totals)),
            frame_keys=tuple(dict.fromkeys(key for _, module in frames for key in writes(module))),
            step_keys=step_keys,
        )


def _sorted(
    modules: Sequence[Placed], carry: Sequence[NestedKey], controls: Sequence[NestedKey]
) -> tuple[list[Placed], list[Placed]]:
    """The modules that read frames alone; and the others, the transition first.

    A module that depends on the action and not on the belief, such as a reading's noise, runs behind the transition. So
    does one that carries entries of its own alone, such as a count.
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
    if not steps:  # the first that reads the belief forecasts it, and writes over it
        first = next(
            index for index, (_, module) in enumerate(driven) if not {*carry}.isdisjoint(chain(*reads(module)))
        )
        steps.append(driven.pop(first))
    made = {key: place for place, module in driven for key in writes(module) if key not in carry}
    for key in chain(*reads(steps[0][1])):
        if key in made:
            raise ValueError(
                f"{steps[0][0]!r} forecasts the belief and reads {key!r}, which {made[key]!r} makes of the action "
                "alone. Let the transition read the action itself, or put both into one module."
            )
    return frames, [*steps[:1], *driven, *steps[1:]]


def _refuse_both(read: Sequence[NestedKey], carry: Sequence[NestedKey], modules: Sequence[Placed]) -> None:
    """Raises where an entry comes from outside and is written, too: the next step would read what this one wrote."""
    for place, module in modules:
        both = [key for key in writes(module) if key in read and key not in carry]
        if both:
            raise ValueError(
                f"{place!r} ({type(module).__name__}) writes {both[0]!r}, which the filter also reads from outside: "
                "the next step would take what this one wrote for a new reading. Write it under another key, and let "
                "the modules behind it read that one; or carry it from step to step: let the initial belief write it."
            )


def _refuse_unread_masks(modules: Sequence[Placed]) -> None:
    """Raises where a module marks readings as missing, and no module looks at its mask."""
    read = {key for _, module in modules for key in chain(*reads(module))}
    for place, module in modules:
        for key in marks_of(module):
            if key not in read:
                raise ValueError(
                    f"{place!r} ({type(module).__name__}) marks readings as missing in {key!r}, which no module of the "
                    f"filter reads: give observed_key={key!r} to the filter or its analysis."
                )


def _forecasts(
    carry: Sequence[NestedKey], written: Sequence[NestedKey], chosen: Mapping[NestedKey, NestedKey]
) -> dict[NestedKey, NestedKey]:
    """Which entry that the transition writes is the forecast of which carried one: that of the same last name."""
    chosen = {unravel_key(key): unravel_key(value) for key, value in chosen.items()}
    unknown = [key for key in chosen if key not in carry] + [key for key in chosen.values() if key not in written]
    if unknown:
        raise ValueError(
            f"forecast_keys names {unknown}; the filter carries {list(carry)}, and {list(written)} is written."
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
            raise ValueError(
                f"The transition writes {same}; say which is the forecast: forecast_keys={{{key!r}: ...}}."
            )
    if not found:
        if len(carry) > 1 or len(written) > 1:
            raise ValueError(
                f"The first module that reads the belief, {list(carry)}, writes {list(written)}, of which none is a "
                "forecast by its name. Say which is: forecast_keys={carried: forecast}."
            )
        found[carry[0]] = written[0]
    return found


def _observation_dims(modules: Sequence[Placed]) -> dict[NestedKey, int]:
    """How many numbers an entry has, where all modules that write it agree."""
    sizes: dict[NestedKey, set[int]] = {}
    for _, module in modules:
        for part in submodels(module):
            own = [part] if role(part, Sensor).observation_dim is not None else in_role(part, Sensor)
            found = {inner.observation_dim for inner in own if inner.observation_dim is not None}
            for key in map(unravel_key, part.out_keys):
                sizes.setdefault(key, set()).update(found)
    return {key: found.pop() for key, found in sizes.items() if len(found) == 1}


def _readings(frames: Sequence[Placed], update: Sequence[Placed], needed: Sequence[NestedKey]) -> list[NestedKey]:
    """The entries from outside of which the analyses' readings are made, through whatever sensors."""
    found: dict[NestedKey, None] = {}
    for _, module in update:
        for part in in_role(module, Update):
            found.update(dict.fromkeys(map(unravel_key, part.reading_keys)))
    for _, module in reversed([*frames, *update]):
        if not found.keys().isdisjoint(writes(module)):
            found.update(dict.fromkeys(reads(module)[0]))
    made_by_steps = {key for _, module in update for key in writes(module)}
    return [key for key in found if key in needed and key not in made_by_steps]


def _plain(update: Sequence[Placed], needed: Sequence[NestedKey]) -> Iterator[NestedKey]:
    """The readings that come from outside as they are; of an analysis they stand in front of their noise."""
    for _, module in update:
        for part in in_role(module, Update):
            first = [unravel_key(key) for key in part.reading_keys[:1]]
            yield from (key for key in first if key in needed)


def _guards(
    frames: Sequence[Placed], update: Sequence[Placed], needed: Sequence[NestedKey], initial: TensorDictModuleBase
) -> tuple[Guard, ...]:
    """What each mask hides, of the entries from outside that the readings are made of."""
    every = [part for module in (*(module for _, module in update), initial) for part in submodels(module)]
    parts = [part for part in every if isinstance(part, Update)]
    made_by_steps = {key for _, module in update for key in writes(module)}
    sources: dict[NestedKey, list[NestedKey]] = {}
    for key in {unravel_key(key) for part in parts for key in part.reading_keys}:
        found = {key: None}
        for _, module in reversed([*frames, *update]):
            if not found.keys().isdisjoint(writes(module)):
                found.update(dict.fromkeys(getattr(module, "source_keys", None) or reads(module)[0]))
        sources[key] = [source for source in found if source in needed and source not in made_by_steps]
    return guards_of(_in_front(every, parts, sources), sources, _made_of(frames, parts))


def _made_of(frames: Sequence[Placed], parts: Sequence[Update]) -> dict[NestedKey, NestedKey]:
    """The mask that each mask is made of, where a part reads one and writes another: hidden is what the first hides."""
    masks = {unravel_key(part.observed_key) for part in parts if part.observed_key is not None}
    found = {made: given for _, module in frames for made, given in marks_of(module).items()}
    for part in parts:
        own = part.observed_key
        if own is not None:
            found.update({key: unravel_key(own) for key in writes(part) if key in masks and key != unravel_key(own)})
    return found


def _in_front(
    every: Sequence[SubModel], parts: Sequence[Update], sources: Mapping[NestedKey, Sequence[NestedKey]]
) -> list[Update]:
    """The parts but for those whose mask another part makes, if others hide the same entries where they come in."""
    made = {key for part in every for key in writes(part) if key != role(part, Update).observed_key}
    first = [part for part in parts if part.observed_key not in made]

    def hidden(some: Sequence[Update]) -> set[NestedKey]:
        keys = (unravel_key(key) for part in some for key in part.reading_keys)
        return {source for key in keys for source in sources[key]}

    covered = hidden(first)
    return [part for part in parts if part in first or not covered.issuperset(hidden([part]))]


def _unmasked(steps: Sequence[Placed], carry: Sequence[NestedKey]) -> Iterator[Placed]:
    """The modules of the update that take in a reading, but name no optional entry, as a mask would be.

    They say what their reading is, or they write the belief and read an entry that no step makes.
    """
    made = {*carry, *(key for _, module in steps for key in writes(module))}
    for place, module in steps[1:]:
        for part in in_sequences(module):
            must, may = reads(part)
            updates = not made.issuperset(must) and not set(carry).isdisjoint(writes(part))
            if not may and (updates or role(part, Update).reading_keys):
                yield place, part


def _refuse_overwriting(modules: Sequence[Placed]) -> None:
    """Raises where all that a module writes is written again before anybody has read it."""
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


def _refuse_unused(steps: Sequence[Placed], belief: Sequence[NestedKey]) -> None:
    """Raises where nobody uses what an analysis writes: its reading would be lost."""
    used = set(belief)
    for place, module in reversed(steps[1:]):
        info = role(module, Update).info_prefix
        made = [key for key in writes(module) if info is None or key[0] != info]
        if made and takes_reading(module) and used.isdisjoint(made):
            raise ValueError(
                f"{place!r} ({type(module).__name__}) takes in {list(module.reading_keys)} and writes {made}, which no "
                "module behind it reads and which is not the belief: the reading would be lost. The next analysis goes "
                "on from there: give it forecast_key= or forecast_prefix= of that name."
            )
        used.update(chain(*reads(module)))


def _refuse_nesting(read: Sequence[NestedKey], written: Sequence[NestedKey]) -> None:
    """Raises where a tensor would have to hold another entry."""
    names = set(read) | set(written)
    for key in written:
        for length in range(1, 1 if isinstance(key, str) else len(key)):
            outer = key[0] if length == 1 else key[:length]
            if outer in names:
                raise ValueError(f"{outer!r} is a tensor, so that {key!r} cannot be written: rename one of them.")


def _apart(steps: Sequence[Placed]) -> tuple[dict[str, dict[NestedKey, NestedKey]], dict]:
    """Names of their own for the diagnostics of several analyses, and what to sum up."""
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
            keys = [key for key in writes(module) if key[0] == info]
            own_info[place] = {key: (info, place, *key[1:]) for key in keys}
            for key in keys:
                if key[-1] in ("nis", "log_likelihood"):
                    totals.setdefault(key, []).append(own_info[place][key])
    return own_info, {key: tuple(values) for key, values in totals.items()}


def _likelihoods(steps: Sequence[Placed], own_info: Mapping, totals: Mapping) -> list[NestedKey]:
    """The log-likelihoods that together are that of all readings."""
    found = []
    for place, module in steps:
        for part in in_sequences(module):
            for key in writes(part):
                if key[0] == role(part, Update).info_prefix and key[-1] == "log_likelihood":
                    found.append(key if key in totals else own_info.get(place, {}).get(key, key))
    return list(dict.fromkeys(found))
