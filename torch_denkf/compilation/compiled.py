"""Runs steps, and chunks of the steps of a sequence, through ``torch.compile``."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from threading import Timer
from types import FunctionType
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from tensordict import NestedKey
from torch import Tensor

from torch_denkf._checks import has_values
from torch_denkf.compilation.compared import check_same_numbers, placed, tensors
from torch_denkf.compilation.libraries import clear_damaged_libraries
from torch_denkf.compilation.options import need_compiler, options_for_processors
from torch_denkf.filters.scan import Steps
from torch_denkf.submodel import Call, Entries

if TYPE_CHECKING:
    from torch_denkf.filters.base import Filter

__all__ = ["CompiledSteps", "filled", "of_one_kind"]

_LOG = logging.getLogger("torch_denkf")
#: Seconds before a first call logs a message.
PATIENCE = 2.0

#: Name of the mask of continuing episodes, among the inputs of a chunk. It is compared like an observed mask: a first
#: call that resets all rows would not test the transition.
_GOES_ON = ("start", "goes on")


class CompiledSteps:
    """Compiled functions of one filter, one for each kind of call: entries, batch size, number of steps.

    They are neither pickled nor copied with the filter: workers compile again.

    Args:
        chunk: steps of a sequence in one graph.
        options: of ``torch.compile``; on a processor, if there are none, the passes of ``torch_denkf.compilation``.
    """

    made, maker = "compiled", "torch's compiler"
    cure = (
        'Use filter.compile(backend="aot_eager"), which leaves the compiler of kernels out, or none, '
        "filter.compile(chunk=0); and please report the filter."
    )

    def __init__(self, chunk: int | None, options: Mapping[str, Any]):
        self.chunk, self.options = chunk, dict(options)
        if self._by_inductor():
            need_compiler()
        self._functions: dict[tuple, tuple[Callable, set]] = {}

    def _compiler_options(self) -> dict[str, Any] | None:
        """Returns the arguments of ``torch.compile``; ``None`` if nothing is compiled."""
        return self.options

    def _by_inductor(self) -> bool:
        options = self._compiler_options()
        return options is not None and options.get("backend", "inductor") == "inductor"

    def __getstate__(self) -> dict:
        return {"chunk": self.chunk, "options": self.options, "_functions": {}}

    def of(self, filter: Filter, steps: Steps | None = None) -> BoundSteps:
        """Returns the filter's steps, compiled, with the interface of :class:`~torch_denkf.filters.scan.Steps`."""
        return BoundSteps(self, filter, filter.steps if steps is None else steps)

    def step(self, steps: Steps, entries: Entries, batch_size: torch.Size) -> Entries:
        """Takes one step; ``entries`` include its noise."""
        keys, writes = tuple(entries), tuple(steps.structure.out_keys)
        make = partial(_step, steps, keys, writes, batch_size)
        values = self._call(("step", keys, batch_size), steps, make, tuple(entries.values()), keys, writes)
        return dict(zip(writes, values, strict=True))

    def scan(self, steps: Steps, carry, inputs, call: Call, resets, starts, cuts, keep) -> tuple[Entries, Entries]:
        """Returns the result of :meth:`Steps.scan`, in chunks; all noise is among the inputs."""
        time, batch, count = len(call.batch_size), call.batch_size, len(cuts)
        keys, start_keys, length = tuple(inputs), tuple(starts), self._length(count)
        whole, named = count, {**inputs}
        if resets is not None:
            # One graph serves all chunks: each step may reset rows, and the last chunk is padded by unused steps. These
            # are resets, so that their values stay bounded.
            whole = -(-count // length) * length
            named |= {
                _GOES_ON: filled(~resets, time, count, True),
                **{("start", key): value for key, value in starts.items()},
            }
        cuts = (*cuts, *[False] * (whole - count))
        pieces = [_pieces(value, time, length, whole, name == _GOES_ON) for name, value in named.items()]
        names = (*steps.structure.carry, *keys, *(() if resets is None else (_GOES_ON, *start_keys)))
        writes, carry, outputs = (*steps.structure.carry, *keep), tuple(map(of_one_kind, carry.values())), []
        for number, now in enumerate(zip(*pieces, strict=True)):
            here = cuts[number * length : (number + 1) * length]
            make = partial(_chunk, steps, keys, start_keys, keep, batch, here)
            mark, *begins = now[len(keys) :] or (None,)
            given = (carry, now[: len(keys)], mark, tuple(begins))
            carry, values = self._call(
                ("chunk", keys, start_keys, batch, here, keep), steps, make, given, names, writes
            )
            outputs.append(values)
        joined = outputs[0] if len(outputs) == 1 else [torch.cat(parts, time) for parts in zip(*outputs, strict=True)]
        out = (value.narrow(time, 0, count) if whole > count else value for value in joined)
        return dict(zip(steps.structure.carry, carry, strict=True)), dict(zip(keep, out, strict=True))

    def _length(self, count: int) -> int:
        """Returns the number of steps in each graph of a sequence of ``count``."""
        return self.chunk

    def _call(self, kind: tuple, steps: Steps, make: partial, inputs: tuple, names: tuple, writes: tuple) -> tuple:
        """Runs the compiled function of a kind; on a miss, compiles it and compares it with the eager one.

        Args:
            kind: key that distinguishes the function from others of the same modules and tensors.
            steps: the filter's steps.
            make: returns the function to compile.
            inputs: inputs of the function.
            names: names of the tensors in ``inputs``.
            writes: names of the tensors that it returns.

        Raises:
            RuntimeError: if its result differs from the eager one.
        """
        some = next(tensors(inputs))
        device = some.device
        kind = (*kind, steps.structure.modules, steps.update_at_reset, device)
        if kind not in self._functions:
            self._functions[kind] = self._made(make, steps, device), set()
        function, compared = self._functions[kind]
        mode = torch.is_grad_enabled(), some.dtype  # torch.compile recompiles for each
        if mode not in compared and self._checked(device) and has_values(some):
            what = f"{self.made} {'step' if kind[0] == 'step' else 'sequence'}"
            with said_when_long(
                f"The {what} of the filter is made: once for each kind of call, and for later processes."
            ):
                check_same_numbers(
                    function,
                    make(),
                    inputs,
                    names=names,
                    outputs=writes,
                    frames=_frames(steps, names),
                    # Gradients of single steps are seldom used, and a backward pass takes long to compile.
                    parameters=None if kind[0] == "step" else _parameters(steps),
                    state=[value for _, module in steps.structure.modules for value in module.buffers()],
                    what=what,
                    cure=self.cure,
                    maker=self.maker,
                )
            compared.add(mode)
        out = function(*inputs)
        return placed(out, (value.clone() for value in tensors(out))) if self._overwrites(device) else out

    def _made(self, make: partial, steps: Steps, device: torch.device) -> Callable:
        """Compiles a function of these steps."""
        function = make()
        if self._by_inductor():
            clear_damaged_libraries()
        # A separate code object: dynamo counts recompilations by code object, and gives up after a few.
        code = function.__code__.replace(co_name=f"{function.__name__}_{len(self._functions)}")
        own = FunctionType(code, function.__globals__, function.__name__, None, function.__closure__)
        return torch.compile(own, fullgraph=True, dynamic=False, **self._arguments(device))

    def _checked(self, device: torch.device) -> bool:
        """Returns True if results are compared with eager ones."""
        return True

    def _overwrites(self, device: torch.device) -> bool:
        """Returns True if the next call overwrites outputs, as with CUDA graphs."""
        graphs = self.options.get("mode") in ("reduce-overhead", "max-autotune")
        graphs = graphs or self.options.get("backend") == "cudagraphs"
        graphs = graphs or (self.options.get("options") or {}).get("triton.cudagraphs", False)
        return bool(graphs) and device.type == "cuda"

    def _arguments(self, device: torch.device) -> dict[str, Any]:
        options = self._compiler_options()
        if options or device.type != "cpu":
            return options
        return {"options": options_for_processors()}


class BoundSteps(NamedTuple):
    """Compiled steps of a filter; noise is drawn outside of the graph.

    Attributes:
        compiled: compiled functions.
        filter: filter that draws the noise.
        steps: eager steps, which are compiled.
    """

    compiled: CompiledSteps
    filter: Filter
    steps: Steps

    def step(self, entries: Entries, call: Call) -> Entries:
        """Takes one step."""
        noise = self.filter.draws.missing(entries, call.batch_size)
        return self.compiled.step(self.steps, {**entries, **noise}, call.batch_size)

    def scan(self, *args: Any) -> tuple[Entries, Entries]:
        """Takes steps sequentially, see :meth:`torch_denkf.filters.scan.Steps.scan`."""
        return self.compiled.scan(self.steps, *args)


@contextmanager
def said_when_long(text: str) -> Iterator[None]:
    """Logs a task that takes longer than :data:`PATIENCE` seconds."""
    timer = Timer(PATIENCE, _LOG.warning, (text,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


def of_one_kind(value: Tensor) -> Tensor:
    """Normalises memory layout and ``requires_grad`` of a belief, as torch.compile recompiles for others."""
    free = torch.is_grad_enabled() and value.is_floating_point() and not value.requires_grad
    return _laid_out(value.detach().requires_grad_() if free else value)


def _laid_out(value: Tensor) -> Tensor:
    """Makes a tensor contiguous, for the same reason, unless it has expanded dimensions."""
    return value if 0 in value.stride() else value.contiguous().view(value.shape)


def _pieces(value: Tensor, time: int, length: int, whole: int, mark: bool) -> Sequence[Tensor]:
    """Splits a value ``[*B, T, ...]`` into chunks with a layout that does not depend on T."""
    value = filled(value, time, whole, False if mark else None)
    if 0 not in value.stride():
        value = _laid_out(value.movedim(time, 0)).movedim(0, time)
    return value.split(length, time)


def filled(value: Tensor, time: int, count: int, fill: bool | None = None) -> Tensor:
    """Pads a value ``[*B, T, ...]`` to ``count`` steps, by default with its last one."""
    lack = count - value.shape[time]
    if lack <= 0:
        return value
    last = value.narrow(time, -1, 1) if fill is None else torch.full_like(value.narrow(time, 0, 1), fill)
    return torch.cat([value, last.expand(*last.shape[:time], lack, *last.shape[time + 1 :])], time)


def _frames(steps: Steps, names: tuple) -> list[NestedKey]:
    """Returns the names of inputs that are neither noise nor beliefs."""
    structure = steps.structure
    others = {*structure.carry, *structure.belief}
    return [name for name in names if name not in others and name[0] not in ("noise", "previous")]


def _parameters(steps: Steps) -> dict[str, Tensor]:
    """Returns the parameters of the modules that run in a chunk."""
    modules = (steps.structure.transition, *steps.structure.update)
    return {f"{place}.{name}": value for place, module in modules for name, value in module.named_parameters()}


def _step(steps: Steps, keys: tuple, writes: tuple, batch: torch.Size) -> Callable:
    def step(*values: Tensor) -> tuple[Tensor, ...]:
        written = steps.step(dict(zip(keys, values, strict=True)), Call(batch))
        return tuple(written[key] for key in writes)

    return step


def _chunk(steps: Steps, keys, start_keys, keep, batch: torch.Size, cuts: tuple) -> Callable:
    def chunk(carry: tuple, inputs: tuple, goes_on: Tensor | None, starts: tuple) -> tuple[tuple, tuple]:
        resets = None if goes_on is None else ~goes_on
        carried = steps.structure.carry
        belief = dict(zip(carried, carry, strict=True))
        begins = dict(zip(start_keys, starts, strict=True)) if starts else {}
        belief, out = steps.scan(belief, dict(zip(keys, inputs, strict=True)), Call(batch), resets, begins, cuts, keep)
        return tuple(belief[key] for key in carried), tuple(out[key] for key in keep)

    return chunk
