"""Adapter between an environment's tensordicts and a packaged step with tensors by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

__all__ = ["PackagedRun", "Step"]


class Step(Protocol):
    """Protocol of a packaged step, such as :class:`torch_denkf.deployment.package.PackagedStep`."""

    @property
    def inputs(self) -> Mapping[str, tuple[tuple[int, ...], str]]:
        """Maps the name of each input to its shape and dtype."""

    @property
    def outputs(self) -> Sequence[str]:
        """Returns the names of the outputs."""

    def __call__(self, entries: Mapping[str, Tensor], /) -> Mapping[str, Tensor]:
        """Takes one step."""


class PackagedRun:
    """Runs a packaged step on the tensordicts of an environment's step.

    Args:
        step: packaged step with attributes ``inputs`` and ``outputs``, from :func:`torch_denkf.deployment.load_step`;
            nested keys are joined by dots.
        carry: maps keys of the belief at t-1 to their keys in the root tensordict.
        controls: keys that are read at the root.
        frames: keys that are read under ``"next"``.
        optional: optional keys under ``"next"``.
        keep: keys that the step must return.

    Raises:
        KeyError: if the step needs an input that the environment's step lacks, or does not return an entry of ``keep``.
    """

    def __init__(
        self,
        step: Step,
        *,
        carry: Mapping[NestedKey, NestedKey],
        controls: Sequence[NestedKey],
        frames: Sequence[NestedKey],
        optional: Sequence[NestedKey],
        keep: Sequence[NestedKey],
    ):
        self.step = step
        root = {_name(key): stored for key, stored in carry.items()} | {_name(key): key for key in controls}
        under_next = {_name(key): key for key in (*frames, *optional)}
        unknown = [name for name in step.inputs if name not in root and name not in under_next]
        if unknown:
            raise KeyError(
                f"the packaged step reads {unknown}, which the filter does not take from an environment (noise, "
                "perhaps: then it is to be drawn inside). Export it from an example without these entries."
            )
        self._root = [(name, root[name]) for name in step.inputs if name in root]
        self._next = [(name, under_next[name]) for name in step.inputs if name not in root]
        # Filters cast controls to the state's precision: an environment may take actions in double precision.
        self._casts = {_name(key): _dtype(step.inputs[_name(key)][1]) for key in controls if _name(key) in step.inputs}
        self._ignored = [key for key in optional if _name(key) not in step.inputs]
        self._outputs = {key: _name(key) for key in keep}
        missing = [key for key, name in self._outputs.items() if name not in step.outputs]
        if missing:
            raise KeyError(f"the packaged step does not return {missing}; export it with out_keys={missing}.")

    def __call__(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> dict[NestedKey, Tensor] | None:
        """Takes a step.

        Returns:
            the entries of ``keep``; ``None`` if an input is missing.

        Raises:
            ValueError: if the environment has an entry that the filter uses and the package does not, or a shape or
                dtype differs from the package's.
        """
        entries = {name: tensordict.get(key, None) for name, key in self._root}
        for name, key in self._next:
            entries[name] = next_tensordict.get(key, None)
        if any(value is None for value in entries.values()):
            return None
        for name, dtype in self._casts.items():
            entries[name] = entries[name].to(dtype)
        for key in self._ignored:
            if next_tensordict.get(key, None) is not None:
                raise ValueError(
                    f"The environment emits {key!r}, which the packaged step was exported without and would ignore. "
                    "Export it from an example that holds the entry."
                )
        out = self.step(entries)
        return {key: out[name] for key, name in self._outputs.items()}


def _dtype(name: str) -> torch.dtype:
    return getattr(torch, name.removeprefix("torch."))


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else ".".join(key)
