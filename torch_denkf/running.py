"""Functions on any TensorDict module: run it on entries, list its inputs and outputs, and its parts that draw noise."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeGuard, TypeVar

import torch
from tensordict import NestedKey, TensorDict, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from torch_denkf._registered import diagnosis
from torch_denkf.functional.manifolds import Space
from torch_denkf.submodel import EXPLAINED, Call, Entries, Sensor, SubModel, role

__all__ = [
    "check_module",
    "in_sequences",
    "is_sequence",
    "linearise",
    "marks_of",
    "named_modules_of",
    "random_parts",
    "reading_of",
    "reads",
    "reads_of",
    "run_module",
    "run_modules",
    "runs_as_written",
    "writes",
]

T = TypeVar("T")


def check_module(name: str, module: Any) -> None:
    """Raises unless an argument is a TensorDict module.

    Raises:
        TypeError: if it is none; the message has ``name``, the argument's name.
    """
    if not (isinstance(module, nn.Module) and hasattr(module, "in_keys") and hasattr(module, "out_keys")):
        made_of = name in ("transition", "observation") and callable(module)
        hint = f", or Learned{name.capitalize()}(f) of a function f" if made_of else ""
        raise TypeError(
            f"{name} must be a TensorDict module, such as those of torch_denkf.modules{hint}; got {module!r}"
        )


def run_module(module: TensorDictModuleBase, entries: Entries, call: Call) -> Entries:
    """Runs a module on entries, and returns its outputs: a sub-model, a sequence, or any TensorDict module.

    Another TensorDict module gets a TensorDict of its own keys only, so that a step and a sequence are alike to it. So
    does a sub-model that overrides ``forward``, or has forward hooks.
    """
    if runs_as_written(module):
        return _explained(module.on_entries, module, entries, call)
    if is_sequence(module) and not (module._forward_hooks or module._forward_pre_hooks):
        return run_modules(named_modules_of(module), entries, call)
    keys, optional = reads(module)
    tensordict = TensorDict({}, batch_size=call.batch_size)
    for key in (*keys, *optional):
        value = entries.get(key)
        if value is not None:
            tensordict.set(key, value)
    for place, part in random_parts(module, call.place):
        for name in part.noise_names:
            value = entries.get(("noise", place, name) if name else ("noise", place))
            if value is not None:
                own = "self" if place == call.place else place.removeprefix(call.place + ".")
                tensordict.set(("noise", own, name) if name else ("noise", own), value)
    missing = [key for key in keys if key not in entries]
    if missing and isinstance(module, TensorDictModule) and not isinstance(module, SubModel):
        raise diagnosis().missing_entry(type(module).__name__, missing, entries)
    tensordict = module(tensordict)
    return {key: tensordict.get(key) for key in map(unravel_key, module.out_keys)}


def linearise(
    module: TensorDictModuleBase, entries: Entries, call: Call
) -> tuple[Entries, Tensor, tuple[Space, Space] | None] | None:
    """Returns a module's declared linearisation, see :meth:`SubModel.linearised`; ``None`` selects autograd."""
    try:
        return _explained(module.linearised, module, entries, call) if runs_as_written(module) else None
    except NotImplementedError:  # a motion or a measurement without a gradient
        return None


def runs_as_written(module: TensorDictModuleBase) -> TypeGuard[SubModel]:
    """Tells whether a module is a sub-model that has no forward hooks and does not override ``forward``."""
    return type(module).forward is SubModel.forward and not (module._forward_hooks or module._forward_pre_hooks)


def _explained(method: Callable[[Entries, Call], T], module: SubModel, entries: Entries, call: Call) -> T:
    try:
        return method(entries, call)
    except EXPLAINED as error:
        if torch.compiler.is_compiling():
            raise
        raise diagnosis().explained(module, error, entries) from error


def run_modules(modules: Iterable[tuple[str, TensorDictModuleBase]], entries: Entries, call: Call) -> Entries:
    """Runs named modules one after the other, and returns their outputs."""
    entries, written = dict(entries), {}
    for name, module in modules:
        out = run_module(module, entries, call.part(name))
        entries.update(out)
        written.update(out)
    return written


def is_sequence(module: Any) -> TypeGuard[TensorDictSequential]:
    """Tells whether a module is a plain sequence of others; a filter, for example, is not.

    Torch's tracer wraps modules in a class of its own that inherits from theirs, so the type alone is not enough.
    """
    return isinstance(module, TensorDictSequential) and type(module).forward is TensorDictSequential.forward


def named_modules_of(sequence: TensorDictSequential) -> list[tuple[str, TensorDictModuleBase]]:
    """Returns the modules of a sequence with their names, which are numbers unless it was made of a dictionary."""
    return list(sequence.module._modules.items())


def reads(module: TensorDictModuleBase) -> tuple[list[NestedKey], list[NestedKey]]:
    """Returns the required keys of a module, and its optional ones."""
    if not is_sequence(module):
        may = [unravel_key(key) for key in getattr(module, "optional_keys", ())]
        must = [key for key in map(unravel_key, module.in_keys) if key not in may]
        return list(dict.fromkeys(must)), list(dict.fromkeys(may))
    return reads_of(part for _, part in named_modules_of(module))


def reads_of(modules: Iterable[TensorDictModuleBase]) -> tuple[list[NestedKey], list[NestedKey]]:
    """Returns the required and the optional keys of modules that run one after the other."""
    needed: dict[NestedKey, None] = {}
    optional: dict[NestedKey, None] = {}
    made: set[NestedKey] = set()
    for module in modules:
        must, may = reads(module)
        needed.update((key, None) for key in must if key not in made)
        optional.update((key, None) for key in may if key not in made)
        made.update(writes(module))
    return list(needed), [key for key in optional if key not in needed]


def writes(module: TensorDictModuleBase) -> list[NestedKey]:
    """Returns the keys that a module writes; for a plain sequence those that its modules currently write."""
    return list(dict.fromkeys(unravel_key(key) for part in in_sequences(module) for key in part.out_keys))


def in_sequences(module: TensorDictModuleBase) -> Iterator[TensorDictModuleBase]:
    """Yields the module, or the modules of a plain sequence."""
    if is_sequence(module):
        for _, part in named_modules_of(module):
            yield from in_sequences(part)
    else:
        yield module


def reading_of(sensor: TensorDictModuleBase) -> NestedKey:
    """Returns the key of a sensor's reading: the first output of its last module that makes a reading."""
    *_, last = (part for part in in_sequences(sensor) if not role(part, Sensor).judges_reading)
    return writes(last)[0]


def marks_of(module: TensorDictModuleBase) -> dict[NestedKey, NestedKey]:
    """Maps each mask that the module writes, which also marks readings it finds missing, to the given mask."""
    return {made: given for part in in_sequences(module) for made, given in role(part, Sensor).marks.items()}


def random_parts(module: TensorDictModuleBase, place: str) -> Iterator[tuple[str, SubModel]]:
    """Yields the sub-models that draw noise, with their places, in the order in which they run."""
    parts: Iterable[tuple[str, TensorDictModuleBase]]
    if isinstance(module, SubModel):
        if module.noise_names:
            yield place, module
        parts = module.parts().items()
    else:
        parts = named_modules_of(module) if is_sequence(module) else ()
    for name, part in parts:
        yield from random_parts(part, name if name and place == "self" else f"{place}.{name}" if name else place)
