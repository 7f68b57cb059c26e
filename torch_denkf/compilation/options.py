"""Options of ``torch.compile`` for small steps, and a filter of its guards."""

from __future__ import annotations

import logging
import re
from collections.abc import Sequence
from typing import Any

import torch

__all__ = ["TESTED_VERSIONS", "need_compiler", "options_for_processors", "worth_checking"]

#: Versions of torch, by their first two numbers, that the passes were tested with.
TESTED_VERSIONS = ("2.13", "2.15")

_LOG = logging.getLogger("torch_denkf")
_said = False


def options_for_processors() -> dict[str, Any]:
    """Returns options of ``torch.compile`` for small steps on a processor."""
    global _said
    version = ".".join(torch.__version__.split(".")[:2])
    if version in TESTED_VERSIONS:
        try:
            from torch_denkf.compilation.kernels import FewCalls
            from torch_denkf.compilation.partition import FewSavedTensors
            from torch_denkf.compilation.scheduling import ShortFunctions

            return {
                "cpp_wrapper": True,
                "custom_partitioner_fn": FewSavedTensors(),
                "post_grad_custom_post_pass": FewCalls(),
                "_post_fusion_custom_pass": ShortFunctions(),
                "guard_filter_fn": worth_checking,
                # Otherwise ten test programs are compiled to detect vector instructions.
                "cpp.vec_isa_ok": True,
            }
        except ImportError as error:
            reason = f"could not be imported ({error})"
    else:
        reason = f"were tested with torch {', '.join(TESTED_VERSIONS)}"
    if not _said:
        _said = True
        _LOG.warning("torch_denkf's passes %s; this is torch %s, so plain inductor compiles.", reason, version)
    return {"cpp_wrapper": True}


def worth_checking(guards: Sequence) -> list[bool]:
    """Selects the guards of torch.compile for values that a user may change; all guards take longer than a step.

    Guards of tensors (also of parameters: dtype and ``requires_grad``), types, numbers and names in modules are kept.
    Guards of definitions in torch and this package, of a module's keys (part of the cache key) and of hooks are
    dropped.
    """

    def may_change(guard) -> bool:
        name = guard.name
        if guard.is_global:
            return not name.startswith(("G['torch", "G['__import_torch", "G['__builtins", "G['___unnamed"))
        never = ("EMPTY_NN_MODULE_HOOKS_DICT", "NOT_PRESENT_IN_GENERIC_DICT", "DICT_NOT_CONTAINS")
        if guard.guard_type in never or name.split("[")[0] in _CLOSED_OVER or name.startswith(_OF_CLASSES):
            return False
        path = re.findall(r"\w+", name)
        return _KEYS.isdisjoint(path) and not (path[:2] == ["steps", "structure"] and path[2:3] not in _MODULES)

    return [may_change(guard) for guard in guards]


#: Constant closure variables of the compiled functions.
_CLOSED_OVER = ("writes", "batch", "cuts", "keep", "keys", "start_keys", "steps")
#: Attributes with keys of entries.
_KEYS = frozenset({"in_keys", "_in_keys", "out_keys", "_out_keys_apparent", "optional_keys", "reading_keys", "_wants"})
#: Attributes of a filter's structure with modules; all others have names.
_MODULES = (["frames"], ["transition"], ["update"], ["posterior"])
#: Prefixes of guards on classes.
_OF_CLASSES = ("dict(type(", "dict(G[", "type(")


def need_compiler() -> None:
    """Checks that inductor finds a C++ compiler.

    Raises:
        RuntimeError: if there is none; the message says what to install.
    """
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise RuntimeError(
            "Compiling a filter needs a C++ compiler (Debian: apt install g++; or set CXX to one); without, leave out "
            "filter.compile(), or pass compiled=False to export_step."
        ) from error
