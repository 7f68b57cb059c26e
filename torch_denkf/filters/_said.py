"""What a filter says once: steps that stay eager, masks that a module does not read, readings that count twice."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING
from weakref import ref

import torch
from tensordict import TensorDictBase, unravel_key
from torch.utils.weak import WeakIdKeyDictionary

from torch_denkf.modules._running import reads

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = [
    "mark_carried",
    "mark_up_to_date",
    "say_eager",
    "say_foreign",
    "say_ignored_mask",
    "say_once",
    "say_up_to_date",
]

#: What environments and data sets call their mask.
_MASK = "observed"
#: What :class:`torch_denkf.data.RecordingReplay` puts behind a table's name.
_OWN_MASK = "_observed"
#: Beliefs that an environment's transform has brought up to the frame beside them.
_UP_TO_DATE = WeakIdKeyDictionary()
#: Beliefs that a policy's filter wrote for its next step, and a reference to that filter.
_CARRIED = WeakIdKeyDictionary()


def say_once(filter: Filter, about: str, text: str) -> None:
    """Warns the first time that ``about`` comes up with this filter; not while torch traces it."""
    if about not in filter._said and not torch.compiler.is_compiling():
        filter._said.add(about)
        warnings.warn(f"{text} Said once.", stacklevel=3)


def say_eager(filter: Filter, why: str, cure: str) -> None:
    """Says that a call of a filter that was compiled runs eagerly."""
    if filter.compiled is not None:
        say_once(filter, why, f"{type(filter).__name__} was compiled, but this call runs eagerly: {why} {cure}")


def say_ignored_mask(filter: Filter, tensordict: TensorDictBase) -> None:
    """Says that a mask hides a reading, which a module uses all the same."""
    if not torch.compiler.is_compiling():
        _say_unread_mask(filter, tensordict)
        _say_held_readings(filter, tensordict)


def _say_unread_mask(filter: Filter, tensordict: TensorDictBase) -> None:
    """Of modules that read no mask.

    A mask is ``"observed"``, or a boolean entry that a sensor or the transition may read. One that a module of the
    update reads is taken to belong to that module's reading.
    """
    structure = filter.structure
    if not structure.unmasked:
        return
    read_in_update = {key for _, module in structure.update for keys in reads(module) for key in keys}
    before = (*structure.frames, structure.transition)
    for key in dict.fromkeys([_MASK, *(key for _, module in before for key in reads(module)[1])]):
        mask = None if key in read_in_update else tensordict.get(key, None)
        if mask is None or mask.dtype != torch.bool or bool(mask.all()):
            continue
        for place, module in structure.unmasked:
            if not any(_is_mask(tensordict.get(unravel_key(name), None)) for name in module.in_keys):
                name = type(module).__name__
                say_once(
                    filter,
                    f"{key!r} at {place!r}",
                    f"The mask {key!r} hides readings, and {name} at place {place!r} reads no mask: it uses a hidden "
                    f"reading like any other. Name the mask in {name}, optional_keys=[{key!r}], and heed it in "
                    "compute(). Where its reading is never missing, there is nothing to do.",
                )


def _say_held_readings(filter: Filter, tensordict: TensorDictBase) -> None:
    """Of a table's readings, which its own mask, ``NAME_observed``, calls held from an earlier row.

    Whether the filter's masks hide them, too, is looked at where the filter reads no other mask than ``"observed"``.
    """
    structure = filter.structure
    for key in structure.readings:
        own = key + _OWN_MASK if isinstance(key, str) else (*key[:-1], key[-1] + _OWN_MASK)
        mask = None if own in structure.optional or own in structure.needed else tensordict.get(own, None)
        if mask is None or mask.dtype != torch.bool or f"{own!r}" in filter._said:
            continue
        used = tensordict.get(_MASK, None) if _MASK in structure.optional else None
        held = ~mask if used is None else ~mask & used.any(-1, keepdim=True)
        if bool(held.any()):
            say_once(
                filter,
                f"{own!r}",
                f"{key!r} has a mask of its own, {own!r}, which no module of {type(filter).__name__} reads: a value "
                "that is held until the next one arrives counts as a new reading each time. Give "
                f"observed_key={own!r} to the filter or its analysis, and to the sensor if there is one.",
            )


def mark_up_to_date(belief: torch.Tensor) -> None:
    """Remembers, as long as it lives, that a belief has seen the frame that an environment emits with it."""
    if not torch.compiler.is_compiling():
        _UP_TO_DATE[belief] = None


def say_up_to_date(filter: Filter, belief: torch.Tensor) -> None:
    """Says that a policy's filter starts its step from a belief that has seen the frame already.

    It is noticed where the environment runs in the same process and nothing copies the belief on its way.
    """
    if not torch.compiler.is_compiling() and belief in _UP_TO_DATE:
        say_once(
            filter,
            "up to date",
            f"{type(filter).__name__} in a policy starts its step from a belief that DEnKFTransform has brought up to "
            "this frame already: each reading counts twice. Keep the filter in one place: in the environment, where "
            "the policy reads ('belief', 'mean'), or in the policy behind filter.make_tensordict_primer().",
        )


def mark_carried(filter: Filter, belief: torch.Tensor) -> None:
    """Remembers, as long as it lives, which policy's filter wrote the belief that it will start from."""
    if not torch.compiler.is_compiling():
        _CARRIED[belief] = ref(filter)


def say_foreign(filter: Filter, belief: torch.Tensor) -> None:
    """Says that a policy's filter starts its step from what another one wrote."""
    writer = None if torch.compiler.is_compiling() else _CARRIED.get(belief)
    if writer is not None and writer() is not filter:
        say_once(
            filter,
            "foreign",
            f"{type(filter).__name__} in a policy starts its step from a belief that another filter wrote. Where both "
            'are in one policy, give one of them a name of its own, prefix="imu" for example.',
        )


def _is_mask(value: object) -> bool:
    return isinstance(value, torch.Tensor) and value.dtype == torch.bool
