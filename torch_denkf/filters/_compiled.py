"""Steps and chunks of sequences through ``torch.compile``, kept for the next call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import FunctionType
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.filters._recursion import Recursion, run
from torch_denkf.modules._row import Row, RowPlan

__all__ = ["CompiledSteps", "need_compiler"]


class CompiledSteps:
    """Compiled functions of one filter, one for each kind of call: entries, batch size, number of steps.

    Neither pickled nor copied with the filter: a worker compiles its own.

    Args:
        chunk: steps of a sequence in one graph.
        options: of ``torch.compile``; on a processor, if there are none, inductor's calls are C++, too.
    """

    def __init__(self, chunk: int, options: Mapping[str, Any]):
        if options.get("backend", "inductor") == "inductor":
            need_compiler()
        self.chunk, self.options = chunk, dict(options)
        self._functions: dict[tuple, Callable] = {}

    def __getstate__(self) -> dict:
        return {"chunk": self.chunk, "options": self.options, "_functions": {}}

    @staticmethod
    def takes(entries: Mapping[NestedKey, Any]) -> bool:
        """Whether all entries are tensors; flipout's noise is none."""
        return all(isinstance(value, Tensor) for value in entries.values())

    def step(self, plan: RowPlan, row: Row, dtype: torch.dtype) -> Row:
        """Takes one step on a row; noise is drawn here, as a sequence draws it."""
        for module in plan.parts:
            key = module.noise_key
            if key is not None and key not in row.entries:
                noise = module.draw_noise(row.batch_size, device=row.device, dtype=dtype)
                if noise is not None:
                    row.set(key, noise)
        if not self.takes(row.entries):
            return run(plan.modules, row)
        keys = tuple(row.entries)
        function = self._function(
            ("step", keys, row.batch_size, row.device),
            plan.modules,
            next(iter(row.entries.values())).device,
            partial(_step, plan.modules, keys, tuple(plan.writes), row.batch_size, row.device),
        )
        return row.update(dict(zip(plan.writes, function(*row.entries.values()), strict=True)))

    def sequence(
        self,
        recursion: Recursion,
        control_keys: Sequence[NestedKey],
        inputs: dict[NestedKey, Tensor],
        is_init: Tensor | None,
        starts: TensorDictBase,
        detach_every: int | None,
    ) -> dict[NestedKey, Tensor]:
        """What the recursion writes on a sequence ``[*B, T]``, in chunks.

        Args:
            recursion: of the filter.
            control_keys: inputs that are read one step earlier.
            inputs: entries ``[*B, T, ...]``.
            is_init: ``[*B, T, 1]``, or ``None``.
            starts: initial beliefs ``[*B, T]``, or ``[*B, 1]`` where ``is_init`` is ``None``.
            detach_every: the belief is detached every so many steps.
        """
        some = next(iter(inputs.values()))
        batch, device, time = starts.batch_size[:-1], starts.device, starts.ndim - 1
        steps = some.shape[time]
        keys = tuple(inputs)
        start_keys = tuple(dict.fromkeys((*recursion.belief_keys, *recursion.carry_keys)))
        start = tuple(starts.get(key) for key in start_keys)

        carry, outputs, begin = (), [], 0
        while begin < steps:
            first = begin == 0  # which also takes the first chunk's steps, if there are as many
            moves = self.chunk if steps - begin - first >= self.chunk else int(not first)
            count, before = first + moves, max(begin - 1, 0)
            cuts = tuple(bool(detach_every) and t % detach_every == 0 for t in range(begin + first, begin + count))
            now = tuple(inputs[key].narrow(time, before if key in control_keys else begin, count) for key in keys)
            resets, begins = None, tuple(value.narrow(time, 0, 1) for value in start) if first else ()
            if is_init is not None:
                resets = is_init.narrow(time, begin, count)
                begins = tuple(value.narrow(time, begin, count) for value in start)
            kind = "first" if first else "chunk", is_init is not None, recursion.update_at_reset
            facts = (*kind, keys, tuple(control_keys), start_keys, batch, device, cuts)
            make = partial(_chunk, recursion, keys, set(control_keys), start_keys, batch, device, time, cuts, first)
            carry, values = self._function(facts, recursion.modules, some.device, make)(carry, now, resets, begins)
            outputs.append(values)
            begin += count
        return {
            key: torch.cat(values, time) if len(values) > 1 else values[0]
            for key, values in zip(recursion.out_keys, zip(*outputs, strict=True), strict=True)
        }

    def _function(self, facts: tuple, modules: tuple, device: torch.device, make: Callable[[], Callable]) -> Callable:
        facts = (*facts, modules, device)  # a part of the filter may be replaced
        if facts not in self._functions:
            function = make()
            # A code object of its own: dynamo counts recompilations by code, and gives up after a few.
            code = function.__code__.replace(co_name=f"{function.__name__}_{len(self._functions)}")
            own = FunctionType(code, function.__globals__, function.__name__, None, function.__closure__)
            arguments = self.options or ({"options": _for_processors()} if device.type == "cpu" else {})
            if "mode" not in arguments:  # torch.compile takes one of the two
                options = {"guard_filter_fn": _worth_checking, **arguments.get("options", {})}
                arguments = {**arguments, "options": options}
            self._functions[facts] = torch.compile(own, fullgraph=True, dynamic=False, **arguments)
        return self._functions[facts]


def _for_processors() -> dict[str, Any]:
    """A step is thirty kernels of a microsecond or two; so calling them, and what they save, must cost little."""
    from torch_denkf.filters._kernels import FewCalls  # they import inductor, which takes half a second
    from torch_denkf.filters._partition import FewSavedTensors

    return {
        "cpp_wrapper": True,
        "custom_partitioner_fn": FewSavedTensors(),
        "post_grad_custom_post_pass": FewCalls(),
    }


def _worth_checking(guards: Sequence) -> list[bool]:
    """What torch.compile checks before each call: all that a user may change. The rest takes longer than a step.

    Tensors (also parameters: their type, whether they are trained), types, numbers and names that modules hold stay.
    What this package and torch define, keys (part of what a function is kept under) and hooks do not.
    """

    def may_change(guard) -> bool:
        if guard.is_global:
            return not guard.name.startswith(("G['torch", "G['__import_torch", "G['__builtins", "G['___unnamed"))
        never = ("EMPTY_NN_MODULE_HOOKS_DICT", "NOT_PRESENT_IN_GENERIC_DICT", "DICT_NOT_CONTAINS")
        return guard.guard_type not in never and "keys" not in guard.name and guard.name.split("[")[0] not in _OWN

    return [may_change(guard) for guard in guards]


#: What the functions below close over, and never changes.
_OWN = ("writes", "batch", "device", "time", "cuts", "first")


def _step(modules: tuple, keys: tuple, writes: tuple, batch, device) -> Callable:
    def step(*values: Tensor) -> tuple[Tensor, ...]:
        row = run(modules, Row(dict(zip(keys, values, strict=True)), batch, device))
        return tuple(row.get(key) for key in writes)

    return step


def _chunk(
    recursion: Recursion, keys, control_keys: set, start_keys, batch, device, time: int, cuts: tuple, first: bool
) -> Callable:
    def rows(names: tuple, values: tuple[Tensor, ...], count: int) -> list[Row]:
        columns = {name: value.unbind(time) for name, value in zip(names, values, strict=True)}
        if first:  # the second step reads what drives it where the first one, which does not move, could have
            for name in control_keys.intersection(names):
                columns[name] = (columns[name][0], *columns[name])
        return [Row({name: column[t] for name, column in columns.items()}, batch, device) for t in range(count)]

    def chunk(carry: tuple, inputs: tuple, resets: Tensor | None, starts: tuple) -> tuple[tuple, tuple]:
        now = rows(keys, inputs, first + len(cuts))
        begins = rows(start_keys, starts, starts[0].shape[time]) if starts else []
        if first:
            outputs = [recursion.first(now[0], begins[0])]
            belief = outputs[0].select(*recursion.carry_keys)
        else:
            outputs, belief = [], Row(dict(zip(recursion.carry_keys, carry, strict=True)), batch, device)
        resets = None if resets is None else resets.unbind(time)[first:]
        belief, later = recursion.roll(belief, now[first:], resets, begins[first:], cuts)
        outputs += later
        stacked = tuple(torch.stack([output.get(key) for output in outputs], time) for key in recursion.out_keys)
        return tuple(belief.get(key) for key in recursion.carry_keys), stacked

    return chunk


def need_compiler() -> None:
    """Checks that inductor finds a C++ compiler.

    Raises:
        RuntimeError: if it does not; the message says what to install.
    """
    from torch._inductor.cpp_builder import get_cpp_compiler
    from torch._inductor.exc import InvalidCxxCompiler

    try:
        get_cpp_compiler()
    except InvalidCxxCompiler as error:
        raise RuntimeError(
            "Compiling a filter needs a C++ compiler (Debian: apt install g++; or set CXX to one); without, leave out "
            "filter.compile()."
        ) from error
