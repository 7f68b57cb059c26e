"""What a filter says once: calls that stay eager, masks that no module reads, readings that count twice."""

from __future__ import annotations

import warnings
from difflib import get_close_matches
from weakref import ref

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torch.utils.weak import WeakIdKeyDictionary

from torch_denkf.filters.structure import Structure
from torch_denkf.running import reads
from torch_denkf.submodel import Entries

__all__ = ["Messages", "mark_up_to_date"]

#: What environments and data sets call their mask.
_MASK = "observed"
#: What :class:`torch_denkf.data.RecordingReplay` puts behind a table's name.
_OWN_MASK = "_observed"
#: Beliefs that an environment's transform has brought up to the frame beside them.
_UP_TO_DATE = WeakIdKeyDictionary()
#: Beliefs that a policy's filter wrote for its next step, and a reference to what that filter says.
_CARRIED = WeakIdKeyDictionary()


def mark_up_to_date(belief: Tensor) -> None:
    """Remembers, as long as it lives, that a belief has seen the frame that an environment emits with it."""
    if not torch.compiler.is_compiling():
        _UP_TO_DATE[belief] = None


class Messages:
    """What one filter says, each thing once; nothing while torch traces it.

    Args:
        name: of the filter's class.
    """

    def __init__(self, name: str):
        self.name = name
        self.said: set[str] = set()
        self._spelt: set[tuple] = set()

    def once(self, about: str, text: str) -> None:
        """Warns the first time that ``about`` comes up."""
        if about not in self.said and not torch.compiler.is_compiling():
            self.said.add(about)
            warnings.warn(f"{text} Said once.", stacklevel=4)

    def eager(self, why: str, cure: str) -> None:
        """Says that a call of a filter that was compiled runs eagerly."""
        self.once(why, f"{self.name} was compiled, but this call runs eagerly: {why} {cure}")

    def ceiling(self, structure: Structure, ceiling: float | None, key: NestedKey) -> None:
        """Says that the variance ``key`` is held at the ceiling."""
        why = "nothing observes what grows."
        if (*key[:-1], "log_weight") in structure.carry:
            why = (
                "some particles have run away, or nothing observes what grows. Particles are held near their weighted "
                "median until a reading takes their weight. If the motion throws single particles away, start from a "
                "narrower belief, or bound the motion."
            )
        text = f"The variance in {key!r} has reached variance_ceiling={ceiling:g} and is held there: {why}"
        self.once("ceiling", text)

    def ceiling_in(self, structure: Structure, ceiling: float | None, written: Entries) -> None:
        """Says whether a variance is held at the ceiling, where a compiled graph could not."""
        if ceiling is None or "ceiling" in self.said or torch.compiler.is_compiling():
            return
        for key in structure.belief:
            value = written.get(key) if key[-1] == "var" else None
            if value is not None and not value.is_cuda and (value >= 0.999 * ceiling).any():
                self.ceiling(structure, ceiling, key)

    def ignored_masks(self, structure: Structure, tensordict: TensorDictBase) -> None:
        """Says that a mask hides a reading, which a module uses all the same."""
        if torch.compiler.is_compiling():
            return
        if structure.unmasked:
            self._unread_mask(structure, tensordict)
        self._misspelt_mask(structure, tensordict)
        for key in structure.readings:
            own = key + _OWN_MASK if isinstance(key, str) else (*key[:-1], key[-1] + _OWN_MASK)
            mask = tensordict.get(own, None)
            if mask is not None:
                self._held_reading(structure, tensordict, key, own, mask)

    def _unread_mask(self, structure: Structure, tensordict: TensorDictBase) -> None:
        """Of modules that read no mask.

        A mask is ``"observed"``, or a boolean entry that a sensor or the transition may read. One that a module of the
        update reads is taken to belong to that module's reading.
        """
        read_in_update = {key for _, module in structure.update for keys in reads(module) for key in keys}
        before = (*structure.frames, structure.transition)
        for key in dict.fromkeys([_MASK, *(key for _, module in before for key in reads(module)[1])]):
            mask = None if key in read_in_update else tensordict.get(key, None)
            if mask is None or mask.dtype != torch.bool or bool(mask.all()):
                continue
            for place, module in structure.unmasked:
                if not any(_is_mask(tensordict.get(unravel_key(name), None)) for name in module.in_keys):
                    name = type(module).__name__
                    self.once(
                        f"{key!r} at {place!r}",
                        f"The mask {key!r} hides readings, and {name} at place {place!r} reads no mask: it uses a "
                        f"hidden reading like any other. Name the mask in {name}, optional_keys=[{key!r}], and heed it "
                        "in compute(). Where its reading is never missing, there is nothing to do.",
                    )

    def _misspelt_mask(self, structure: Structure, tensordict: TensorDictBase) -> None:
        """Of a boolean entry that nothing reads, named nearly like a mask that is read and is not there."""
        present = tuple(tensordict.keys())
        if present in self._spelt:
            return
        self._spelt.add(present)
        read = {*structure.optional, *structure.needed}
        # What is the mask of another entry that is there belongs to that entry.
        others = {f"{key}{_OWN_MASK}" for key in present}
        unread = [key for key in present if key not in read and key not in others]
        for key in structure.optional:
            if isinstance(key, str) and key.endswith(_MASK) and key not in present:
                for other in get_close_matches(key, unread, n=1, cutoff=0.85):
                    if not _is_mask(tensordict.get(other)):
                        continue
                    self.once(
                        f"{key!r} as {other!r}",
                        f"{self.name} reads the mask {key!r}, which is not there, and nothing reads {other!r}: each "
                        f"reading counts as observed. If {other!r} is that mask, rename it, or pass "
                        f"observed_key={other!r}.",
                    )

    def _held_reading(
        self, structure: Structure, tensordict: TensorDictBase, key: NestedKey, own: NestedKey, mask: Tensor
    ) -> None:
        """Of a table's reading, which its own mask, ``NAME_observed``, calls held from an earlier row.

        Whether the filter's masks hide it, too, is looked at where the filter reads no other mask than ``"observed"``.
        """
        if own in structure.optional or own in structure.needed or mask.dtype != torch.bool:
            return
        used = tensordict.get(_MASK, None) if _MASK in structure.optional else None
        held = ~mask if used is None else ~mask & used.any(-1, keepdim=True)
        if f"{own!r}" not in self.said and bool(held.any()):
            self.once(
                f"{own!r}",
                f"{key!r} has a mask of its own, {own!r}, which no module of {self.name} reads: a value that is held "
                f"until the next one arrives counts as a new reading each time. Give observed_key={own!r} to the "
                "filter or its analysis, and to the sensor if there is one.",
            )

    def wrong_start(self, belief: Tensor) -> None:
        """Says that a policy's filter starts its step from a belief that is not its own, or has seen the frame already.

        It is noticed where the environment runs in the same process and nothing copies the belief on its way.
        """
        if torch.compiler.is_compiling():
            return
        if belief in _UP_TO_DATE:
            self.once(
                "up to date",
                f"{self.name} in a policy starts its step from a belief that DEnKFTransform has brought up to this "
                "frame already: each reading counts twice. Keep the filter in one place: in the environment, where "
                "the policy reads ('belief', 'mean'), or in the policy behind filter.make_tensordict_primer().",
            )
        writer = _CARRIED.get(belief)
        if writer is not None and writer() is not self:
            self.once(
                "foreign",
                f"{self.name} in a policy starts its step from a belief that another filter wrote. Where both are in "
                'one policy, give one of them a name of its own, prefix="imu" for example.',
            )

    def mark_carried(self, belief: Tensor) -> None:
        """Remembers, as long as it lives, that this filter wrote the belief for its next step in a policy."""
        if not torch.compiler.is_compiling():
            _CARRIED[belief] = ref(self)


def _is_mask(value: object) -> bool:
    return isinstance(value, Tensor) and value.dtype == torch.bool
