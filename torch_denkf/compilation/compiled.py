"""Steps and chunks of sequences through ``torch.compile``, kept for the next call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import FunctionType
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor

from torch_denkf._checks import has_values
from torch_denkf._registered import compiler
from torch_denkf.filters.gather import Rows
from torch_denkf.filters.scan import Steps
from torch_denkf.submodel import Call, Entries

__all__ = ["CompiledSteps"]

#: Where an episode begins, among the names of what a chunk takes.
_BEGINS = ("start", "begins")


class CompiledSteps:
    """Compiled functions of one filter, one for each kind of call: entries, batch size, number of steps.

    Neither pickled nor copied with the filter: a worker compiles its own.

    Args:
        chunk: steps of a sequence in one graph.
        options: of ``torch.compile``; on a processor, if there are none, the passes of ``torch_denkf.compilation``.
    """

    def __init__(self, chunk: int, options: Mapping[str, Any]):
        if chunk < 0:
            raise ValueError(f"chunk is a number of steps, or 0 for none; got {chunk}.")
        if options.get("backend", "inductor") == "inductor":
            compiler().need_compiler()
        self.chunk, self.options = chunk, dict(options)
        self._functions: dict[tuple, tuple[Callable, set]] = {}

    def __getstate__(self) -> dict:
        return {"chunk": self.chunk, "options": self.options, "_functions": {}}

    def step(
        self, steps: Steps, entries: Entries, batch_size: torch.Size, missing: frozenset[NestedKey] = frozenset()
    ) -> Entries:
        """What one step writes; ``entries`` hold its noise, and ``missing`` names what they do not hold."""
        keys, writes = tuple(entries), (*steps.structure.frame_keys, *steps.step_keys)
        writes = tuple(key for key in writes if key not in missing)
        make = partial(_step, steps, keys, writes, batch_size, missing)
        values = self._call(("step", keys, batch_size, missing), steps, make, tuple(entries.values()), keys, writes)
        return dict(zip(writes, values, strict=True))

    def sequence(self, steps: Steps, rows: Rows, cuts: Sequence[bool], keep: tuple[NestedKey, ...]) -> Entries:
        """What the steps write on a sequence ``[*B, T]``, in chunks; all noise is among the inputs."""
        time, count = len(rows.size) - 1, rows.size[-1]
        batch = torch.Size(rows.size[:-1])
        inputs, starts, begins = rows.inputs, rows.starts, rows.begins
        keys, start_keys = tuple(inputs), tuple(starts)
        carry, outputs, begin = (), [], 0
        while begin < count:
            first = begin == 0  # which also takes the first chunk's steps, if there are as many
            length = first + (self.chunk if count - begin - first >= self.chunk else int(not first))
            here = tuple(cuts[begin : begin + length])
            now = tuple(inputs[key].narrow(time, begin, length) for key in keys)
            resets, now_starts = None, tuple(value.narrow(time, 0, 1) for value in starts.values()) if first else ()
            if begins is not None:
                resets = begins.narrow(time, begin, length)
                now_starts = tuple(value.narrow(time, begin, length) for value in starts.values())
            kind = ("first" if first else "chunk", begins is not None, keys, start_keys, batch, here, keep)
            make = partial(_chunk, steps, keys, start_keys, keep, batch, here, first)
            carried = () if first else steps.structure.carry
            names = (*carried, *keys, *(() if begins is None else (_BEGINS,)), *(start_keys if now_starts else ()))
            given, writes = (carry, now, resets, now_starts), (*steps.structure.carry, *keep)
            carry, values = self._call(kind, steps, make, given, names, writes)
            outputs.append(values)
            begin += length
        if len(outputs) == 1:
            return dict(zip(keep, outputs[0], strict=True))
        columns = zip(*outputs, strict=True)
        return {key: torch.cat(values, time) for key, values in zip(keep, columns, strict=True)}

    def _call(self, kind: tuple, steps: Steps, make: Callable, inputs: tuple, names: tuple, writes: tuple) -> tuple:
        """What the compiled function of a kind returns, which is compiled, and compared, where there is none yet.

        Args:
            kind: what tells the function from others, beside the filter's modules and what tensors it takes.
            steps: the filter's.
            make: returns the function to compile.
            inputs: what it takes.
            names: of the tensors in ``inputs``.
            writes: names of the tensors that it returns.

        Raises:
            RuntimeError: if it does not return what it returns eagerly.
        """
        room = compiler()
        some = next(room.tensors(inputs))
        device = some.device
        kind = (*kind, steps.structure.modules, steps.update_at_reset, steps.ceiling, steps.reject, device)
        if kind not in self._functions:
            if self.options.get("backend", "inductor") == "inductor":
                room.clear_damaged_libraries()
            function = make()
            # A code object of its own: dynamo counts recompilations by code, and gives up after a few.
            code = function.__code__.replace(co_name=f"{function.__name__}_{len(self._functions)}")
            own = FunctionType(code, function.__globals__, function.__name__, None, function.__closure__)
            compiled = torch.compile(own, fullgraph=True, dynamic=False, **self._arguments(device))
            self._functions[kind] = compiled, set()
        function, compared = self._functions[kind]
        mode = torch.is_grad_enabled(), some.dtype  # for each torch.compile compiles anew
        if mode not in compared and has_values(some):
            room.refuse_other_numbers(
                function,
                make(),
                inputs,
                names=names,
                outputs=writes,
                frames=_frames(steps, names),
                # Who records gradients of single steps seldom wants them; a backward pass takes as long to compile.
                parameters=None if kind[0] == "step" else _parameters(steps),
                state=[value for _, module in steps.structure.modules for value in module.buffers()],
                what="compiled step" if kind[0] == "step" else "compiled sequence",
                cure='Use filter.compile(backend="aot_eager"), which leaves the compiler of kernels out, or none, '
                "filter.compile(chunk=0); and please report the filter.",
            )
            compared.add(mode)
        out = function(*inputs)
        return room.placed(out, (value.clone() for value in room.tensors(out))) if self._overwrites(device) else out

    def _overwrites(self, device: torch.device) -> bool:
        """Whether outputs lie in memory that the next call uses again: that of CUDA graphs."""
        graphs = self.options.get("mode") in ("reduce-overhead", "max-autotune")
        graphs = graphs or self.options.get("backend") == "cudagraphs"
        graphs = graphs or (self.options.get("options") or {}).get("triton.cudagraphs", False)
        return bool(graphs) and device.type == "cuda"

    def _arguments(self, device: torch.device) -> dict[str, Any]:
        if self.options or device.type != "cpu":
            return self.options
        return {"options": compiler().options_for_processors()}


def _frames(steps: Steps, names: tuple) -> list[NestedKey]:
    """Which inputs are neither noise nor beliefs, nor say where an episode begins."""
    structure = steps.structure
    others = {*structure.carry, *structure.belief, _BEGINS}
    return [name for name in names if name not in others and name[0] != "noise"]


def _parameters(steps: Steps) -> dict[str, Tensor]:
    """Of the modules that run in a chunk."""
    modules = (steps.structure.transition, *steps.structure.update)
    return {f"{place}.{name}": value for place, module in modules for name, value in module.named_parameters()}


def _step(steps: Steps, keys: tuple, writes: tuple, batch: torch.Size, missing: frozenset) -> Callable:
    def step(*values: Tensor) -> tuple[Tensor, ...]:
        written = steps.step(dict(zip(keys, values, strict=True)), Call(batch), missing=missing)
        return tuple(written[key] for key in writes)

    return step


def _chunk(steps: Steps, keys, start_keys, keep, batch: torch.Size, cuts: tuple, first: bool) -> Callable:
    def chunk(carry: tuple, inputs: tuple, resets: Tensor | None, starts: tuple) -> tuple[tuple, tuple]:
        carried = steps.structure.carry
        belief = None if first else dict(zip(carried, carry, strict=True))
        begins = dict(zip(start_keys, starts, strict=True)) if starts else {}
        belief, out = steps.scan(belief, dict(zip(keys, inputs, strict=True)), Call(batch), resets, begins, cuts, keep)
        return tuple(belief[key] for key in carried), tuple(out[key] for key in keep)

    return chunk
