"""Hook points of the training loop for torchrl's trainer hooks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict import TensorDictBase

__all__ = ["HookPoints"]

_POINTS = {
    "pre_optim_steps": "before every update; no argument",
    "process_optim_batch": "maps every training batch to a batch",
    "post_optim": "after every update; no argument",
    "pre_steps_log": "maps the batch of an update that is logged to {name: value}",
    "post_optim_log": "the same, after the update",
}


class HookPoints:
    """Registers hooks like torchrl's ``Trainer``: ``hook.register(trainer)`` or ``trainer.register_op(place, hook)``.

    It has these of torchrl's places: ``"pre_optim_steps"``, ``"process_optim_batch"``, ``"post_optim"``, and, at
    updates that are logged only, ``"pre_steps_log"`` and ``"post_optim_log"``. So ``ClearCudaCache``,
    ``BatchSubSampler``, ``LogScalar`` and ``LogTiming`` work as they are.

    Example:
        >>> points = HookPoints()
        >>> points.register_op("process_optim_batch", lambda batch: batch[:2])
        >>> points._hooked_batch([1, 2, 3])
        [1, 2]
    """

    def __init__(self):
        self._ops: dict[str, list] = {place: [] for place in _POINTS}
        self._hook_modules: dict[str, Any] = {}

    def register_op(self, dest: str, op: Callable, **kwargs) -> None:
        """Registers ``op(..., **kwargs)`` at a place of the loop.

        Raises:
            ValueError: if the loop has no such place.
        """
        if dest not in _POINTS:
            places = "; ".join(f"{name!r} ({what})" for name, what in _POINTS.items())
            raise ValueError(f"FilterTrainer has no place {dest!r} for a hook; it has {places}.")
        self._ops[dest].append((op, kwargs))

    def register_module(self, module_name: str, module: Any) -> None:
        """Includes ``module``'s ``state_dict`` in the checkpoints.

        Raises:
            ValueError: if the name is taken.
        """
        if module_name in self._hook_modules:
            raise ValueError(f"A hook named {module_name!r} is registered already; give this one another name.")
        self._hook_modules[module_name] = module

    def _call_hooks(self, place: str) -> None:
        for op, kwargs in self._ops[place]:
            op(**kwargs)

    def _hooked_batch(self, batch: TensorDictBase) -> TensorDictBase:
        for op, kwargs in self._ops["process_optim_batch"]:
            result = op(batch, **kwargs)
            batch = batch if result is None else result
        return batch

    def _hooked_values(self, place: str, batch: TensorDictBase) -> dict[str, float]:
        values: dict[str, float] = {}
        for op, kwargs in self._ops[place]:
            values.update(op(batch, **kwargs) or {})
        values.pop("log_pbar", None)  # torchrl's flag for the progress bar, not a value
        return values

    def _hook_state(self) -> dict[str, Any]:
        return {name: module.state_dict() for name, module in self._hook_modules.items()}

    def _load_hook_state(self, state: dict[str, Any]) -> None:
        for name, module in self._hook_modules.items():
            if name in state:
                module.load_state_dict(state[name])
