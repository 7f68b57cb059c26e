"""What a filter's modules say about themselves, looked up once and not in every sequence."""

from __future__ import annotations

from collections.abc import Container, Iterable
from dataclasses import dataclass

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase

from torch_denkf.modules import SubModel
from torch_denkf.modules._row import RowPlan

__all__ = ["Known", "inputs_of", "submodels"]


@dataclass
class Known:
    """What a filter's modules say, so that a sequence need not walk through them.

    Attributes:
        modules: those that it was looked up for, and the initial belief.
        parts: all sub-models.
        inputs: entries that the recursion reads and does not write.
        plans: of the last recursion, see :class:`~torch_denkf.filters._recursion.Recursion`.
    """

    modules: tuple[TensorDictModuleBase, ...]
    parts: tuple[SubModel, ...]
    inputs: list[NestedKey]
    plans: tuple[RowPlan | None, RowPlan | None] = (None, None)


def submodels(module: torch.nn.Module) -> list[SubModel]:
    """Returns the sub-models inside ``module``, also those inside a nested sequence."""
    return [part for part in module.modules() if isinstance(part, SubModel)]


def inputs_of(modules: Iterable[TensorDictModuleBase], own: Container[NestedKey]) -> list[NestedKey]:
    """Returns what ``modules`` read, if it is there, that is not among their ``own`` entries."""
    modules = tuple(modules)
    keys = [key for module in modules for key in module.in_keys]
    for part in (part for module in modules for part in submodels(module)):
        keys += [*part.optional_keys, *([] if part.noise_key is None else [part.noise_key])]
    return [key for key in dict.fromkeys(map(unravel_key, keys)) if key not in own]
