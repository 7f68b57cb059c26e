"""Wrappers around a module in its role, and an initial belief with further entries."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable, Sequence
from typing import Self, TypeVar

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf.running import check_module, reads, run_module, writes
from torch_denkf.submodel import Call, Entries, Initial, SubModel, Update, role

__all__ = ["Around", "AroundInitial", "AugmentedBelief", "Wrapper", "passes_on"]

W = TypeVar("W", bound="Wrapper")


class _Inside:
    """Descriptor of a wrapper that forwards to the module inside, unless the wrapper defines the name itself."""

    def __init__(self, kind: type[SubModel], name: str):
        self.kind, self.name = kind, name

    def __get__(self, wrapper, owner=None):
        return self if wrapper is None else getattr(role(wrapper.module, self.kind), self.name)


class Wrapper(SubModel):
    """Wraps another module and replaces it: keys, noise and its name are those of the module inside.

    A sub-class overrides what it changes, mostly :meth:`on_entries`. :class:`Around` and :class:`AroundInitial` also
    forward the declarations of the module inside in its role, such as the ``reading_keys`` of an update.

    Args:
        module: any TensorDict module.
        in_keys: inputs of the wrapper; those of the module by default.
        out_keys: outputs of the wrapper; those of the module by default.
        optional_keys: optional inputs of the wrapper; those of the module by default.
        further_keys: inputs of the wrapper in addition to ``in_keys``.

    Attributes:
        place: name of the module inside, if its noise is nested in the wrapper's, ``("noise",
            "transition.transition")``; ``None`` if its noise has the wrapper's place.
    """

    place: str | None = None

    def __init__(
        self,
        module: TensorDictModuleBase,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
        *,
        optional_keys: Sequence[NestedKey] | None = None,
        further_keys: Sequence[NestedKey] = (),
    ):
        check_module(self.place or "module", module)
        needed, optional = reads(module)
        super().__init__(
            module,
            list(dict.fromkeys(map(unravel_key, [*(needed if in_keys is None else in_keys), *further_keys]))),
            writes(module) if out_keys is None else out_keys,
            optional_keys=optional if optional_keys is None else optional_keys,
        )

    def parts(self):
        """Returns the module inside, under the empty name if its noise has the wrapper's place."""
        return {self.place or "": self.module}

    def run_inside(self, entries: Entries, call: Call) -> Entries:
        """Runs the module inside and returns its outputs."""
        return run_module(self.module, entries, call if self.place is None else call.part(self.place))

    def on_entries(self, entries, call):
        """Runs the module inside."""
        return self.run_inside(entries, call)


def passes_on(kind: type[SubModel]) -> Callable[[type[W]], type[W]]:
    """Makes a class of wrappers forward the declarations of a role that the class does not define itself."""

    def passing(wrapper: type[W]) -> type[W]:
        for name in vars(kind):
            if not name.startswith("_") and name not in vars(wrapper):
                setattr(wrapper, name, _Inside(kind, name))
        return wrapper

    return passing


@passes_on(Update)
class Around(Wrapper, Update):
    """Wraps an update, and forwards its declarations; a sub-class overrides some of them.

    A wrapper that corrects a lag window, such as that of :class:`~torch_denkf.smoothers.FixedLag`, is put inside this
    one, see :meth:`around`.

    Args:
        module: the update inside.
        in_keys: inputs of the wrapper; those of the update by default.
        out_keys: outputs of the wrapper; those of the update by default.
        optional_keys: optional inputs of the wrapper; those of the update by default.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import EnsembleAnalysis
        >>> class ScaledInnovation(Around):
        ...     def __init__(self, analysis, share):
        ...         super().__init__(analysis)
        ...         self.share = share
        ...
        ...     def on_entries(self, entries, call):
        ...         key = self.reading_keys[0]
        ...         innovation = self.run_inside(entries, call)[self.info_prefix, "innovation"]
        ...         less = (1 - self.share) * innovation
        ...         if entries[key].ndim > innovation.ndim:  # samples [*B, E, O]
        ...             less = less.unsqueeze(-2)
        ...         return self.run_inside({**entries, key: entries[key] - less}, call)
        >>> members = torch.tensor([[-1.0], [1.0]])
        >>> td = TensorDict({
        ...     "forecast": {"ensemble": members, "observation": members},
        ...     "sensor": {"ensemble": torch.tensor([4.0]), "noise": torch.tensor([2.0])},
        ... })
        >>> ScaledInnovation(EnsembleAnalysis("etkf"), 0.5)(td)["belief", "mean"]
        tensor([1.])
    """

    updates_ensemble = False  # a lag window around the wrapper would bypass its changes
    aligned, on_aligned = Update.aligned, Update.on_aligned

    def around(self, update: Update) -> Self:
        """Returns the same wrapper around another update of the same reading, parameters shared.

        Args:
            update: e.g. a :class:`~torch_denkf.smoothers.past.LaggedAnalysis` of the update inside.
        """
        other = copy.copy(self)
        for name in ("_parameters", "_buffers", "_modules"):
            setattr(other, name, dict(getattr(self, name)))
        for name in ("in_keys", "out_keys", "optional_keys"):
            inside, own = (list(getattr(module, name)) for module in (self.module, self))
            setattr(other, name, [*getattr(update, name), *(key for key in own if key not in inside)])
        other.module = update
        return other


@passes_on(Initial)
class AroundInitial(Wrapper, Initial):
    """Wraps an initial belief, and forwards its declarations."""


class AugmentedBelief(AroundInitial):
    """Adds further entries to an initial belief, which are reset with the episode.

    Args:
        initial: the initial belief.
        keys: the further entries.
        begin: returns their values, in that order, from the belief (its tensors by key) and its batch size. For
            pickling, use a function of a module, with options in a :class:`functools.partial`.
        follow_keys: entries of the belief that are computed from the carried ones.
        follow: returns their values, in that order, from the carried entries, or from those of ``begin``.
        nested: whether the noise of ``initial`` is nested in this module's: ``("noise", "initial.initial")``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior
        >>> def no_steps(belief, batch_size):
        ...     return [torch.zeros(*batch_size, 1)]
        >>> start = AugmentedBelief(GaussianPrior([0.0], [1.0], ensemble_size=4), ["steps"], no_steps)
        >>> start(TensorDict({}, [3]))["steps"].flatten()
        tensor([0., 0., 0.])
    """

    def __init__(
        self,
        initial: TensorDictModuleBase,
        keys: Sequence[NestedKey],
        begin: Callable[[Entries, torch.Size], Iterable[torch.Tensor]],
        *,
        follow_keys: Sequence[NestedKey] = (),
        follow: Callable[[Entries], Iterable[torch.Tensor]] | None = None,
        nested: bool = False,
    ):
        check_module("initial", initial)
        own, follow_keys = ([*map(unravel_key, some)] for some in (keys, follow_keys))
        super().__init__(initial, out_keys=list(dict.fromkeys([*initial.out_keys, *own, *follow_keys])))
        self.keys, self.begin, self.follow_keys, self.follow = own, begin, follow_keys, follow
        self.place = "initial" if nested else None

    def on_entries(self, entries, call):
        """Writes the belief and the further entries."""
        written = dict(self.run_inside(entries, call))
        written.update(zip(self.keys, self.begin(written, call.batch_size), strict=True))
        return {**written, **self._following(written)}

    def derived(self, carried):
        """Returns the derived entries of the module inside and of this module."""
        return {**role(self.module, Initial).derived(carried), **self._following(carried)}

    def _following(self, entries: Entries) -> Entries:
        return {} if self.follow is None else dict(zip(self.follow_keys, self.follow(entries), strict=True))
