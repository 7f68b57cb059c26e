"""Records steps, and their backward pass, in CUDA graphs: an eager step has a hundred launches, a replay one."""

from __future__ import annotations

import gc
import warnings
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from torch_denkf._checks import check_count
from torch_denkf.compilation.compared import placed, put_back, tensors
from torch_denkf.compilation.compiled import CompiledSteps, of_one_kind
from torch_denkf.compilation.in_time import InTime
from torch_denkf.filters.scan import Steps
from torch_denkf.filters.structure import Structure
from torch_denkf.submodel import Call, Entries

__all__ = ["CapturedSteps"]

#: Warm-up runs before a recording: the first loads libraries, the second detects synchronisations with the device.
_WARM = 2


class CudaRecorder:
    """Records the kernel launches of a function, on one device."""

    #: One stream per device, as each has a workspace of cuBLAS.
    streams: ClassVar[dict[torch.device, Any]] = {}

    def __init__(self, device: torch.device):
        if device not in self.streams:
            self.streams[device] = torch.cuda.Stream(device)
        self.device, self.stream, self.pool = device, self.streams[device], None

    @contextmanager
    def _prepared(self) -> Iterator[None]:
        """Avoids MAGMA, which allocates memory and synchronises, and restores the state of the random generators."""
        library = torch.backends.cuda.preferred_linalg_library()
        torch.backends.cuda.preferred_linalg_library("cusolver")
        try:
            with torch.random.fork_rng([self.device]):
                yield
        finally:
            torch.backends.cuda.preferred_linalg_library(library)

    def waits(self, run: Callable) -> list[str]:
        """Runs a function, and lists the lines of code that synchronise with the device."""
        before = torch.cuda.get_sync_debug_mode()
        with self._prepared(), warnings.catch_warnings(record=True) as said:
            self.stream.wait_stream(torch.cuda.current_stream(self.device))
            with torch.cuda.stream(self.stream):
                for turn in range(_WARM):
                    if turn == _WARM - 1:
                        warnings.simplefilter("always")
                        torch.cuda.set_sync_debug_mode("warn")
                    try:
                        run()
                    finally:
                        torch.cuda.set_sync_debug_mode(before)
            torch.cuda.current_stream(self.device).wait_stream(self.stream)
        # Enabling the mode itself warns once per process.
        return sorted({f"{w.filename}:{w.lineno}" for w in said if "called a synchronizing" in str(w.message)})

    def record(self, run: Callable) -> Callable:
        """Returns a function that replays the launches of ``run``, and returns its tensors."""
        graph = torch.cuda.CUDAGraph()
        context = {"pool": self.pool, "stream": self.stream, "capture_error_mode": "thread_local"}
        with _no_collection(), self._prepared(), torch.cuda.graph(graph, **context):
            results = run()
        self.pool = graph.pool()  # the backward pass reads tensors that the forward pass saved there

        def replay() -> Any:
            graph.replay()
            return results

        return replay


@contextmanager
def _no_collection() -> Iterator[None]:
    """Keeps the garbage collector from freeing an older graph during a recording, which would break it."""
    gc.collect()
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


class CapturedSteps(CompiledSteps):
    """Runs steps and sequences as CUDA graphs; on other devices eagerly, with one warning.

    A replay reads and writes static memory, so that inputs and outputs are copied. Graphs are recorded for each kind of
    call, and again after parameters move or modules switch between training and evaluation. Python numbers, such as an
    inflation, are constants of the recording.

    Args:
        chunk: steps of a sequence in one graph; ``None`` for all.
        options: ``mode="graph"``; with further options of ``torch.compile``, one step is compiled, and the graphs
            record it.
    """

    made, maker = "recorded", "CUDA's graphs"
    cure = "Use filter.compile(chunk=0), which goes back to eager; and please report the filter."
    recorder: Callable = CudaRecorder

    def __init__(self, chunk: int | None, options: dict):
        super().__init__(chunk, options)
        self._said = False

    def __getstate__(self) -> dict:
        return {**super().__getstate__(), "_said": False}

    def _compiler_options(self) -> dict | None:
        return {name: value for name, value in self.options.items() if name != "mode"} or None

    def _length(self, count: int) -> int:
        return min(self.chunk or count, count)

    def _made(self, make: partial, steps: Steps, device: torch.device) -> Callable:
        if device.type != "cuda" and self.recorder is CudaRecorder:
            if not self._said:
                self._said = True
                warnings.warn(
                    f'filter.compile(mode="graph") records CUDA graphs; on {device.type!r} steps run eagerly. '
                    "filter.compile() compiles for a processor.",
                    stacklevel=2,
                )
            return make()
        options, structure = self._compiler_options(), steps.structure
        function = make() if options is None else make.func(StepByStep(Unchecked(1, options), steps), *make.args[1:])
        placed_modules = (*structure.modules, *structure.posterior)
        return Captured(function, [module for _, module in placed_modules], partial(self.recorder, device))

    def _checked(self, device: torch.device) -> bool:
        return device.type == "cuda" or self.recorder is not CudaRecorder


class Unchecked(CompiledSteps):
    """Compiled steps without a comparison of the results."""

    def _checked(self, device: torch.device) -> bool:
        return False


class StepByStep(NamedTuple):
    """One compiled step, called in a loop: compiling a longer function would take minutes.

    Attributes:
        compiled: compiled functions.
        steps: eager steps.
    """

    compiled: CompiledSteps
    steps: Steps

    @property
    def structure(self) -> Structure:
        """Returns the filter's structure."""
        return self.steps.structure

    def step(self, entries: Entries, call: Call) -> Entries:
        """Takes one step."""
        with _backward_again():
            return self.compiled.step(self.steps, entries, call.batch_size)

    def scan(self, carry, inputs, call: Call, resets, starts, cuts, keep) -> tuple[Entries, Entries]:
        """Takes steps sequentially, all of the same kind: if one may reset rows, all may."""
        time, outputs = len(call.batch_size), []
        for t, cut in enumerate(cuts):
            carry = {key: of_one_kind(value.detach() if cut else value) for key, value in carry.items()}
            reset, start = resets, starts
            if resets is not None:
                may = t < resets.shape[time]
                reset, start = resets.narrow(time, t if may else 0, 1), _at(starts, time, t if may else 0)
                reset = reset if may else torch.zeros_like(reset)
            now = _at(inputs, time, t)
            with _backward_again():
                carry, out = self.compiled.scan(self.steps, carry, now, call, reset, start, (False,), keep)
            outputs.append(out)
        return carry, {key: torch.cat([out[key] for out in outputs], time) for key in keep}


def _at(entries: Entries, time: int, t: int) -> Entries:
    return {key: value.narrow(time, t, 1) for key, value in entries.items()}


def _backward_again() -> AbstractContextManager:
    """Keeps the inputs of a compiled backward pass, for warm-up runs and the recording."""
    import torch._functorch.config as config

    return config.patch(donated_buffer=False)


class Captured:
    """A function of tensors that is recorded at its first call of a kind, and then replayed.

    Args:
        function: takes and returns nested tuples of tensors.
        modules: modules whose parameters and buffers it reads.
        recorder: constructor of a recorder, see :class:`CudaRecorder`.
    """

    def __init__(self, function: Callable, modules: Sequence[nn.Module], recorder: Callable):
        self.function, self.recorder = function, recorder
        self.modules = list(dict.fromkeys(part for module in modules for part in module.modules()))
        self.graphs: dict[tuple, list[Graph] | None] = {}

    def __call__(self, *inputs: Any) -> Any:
        """Replays a graph that no pending backward pass needs; records one if there is none."""
        values = list(tensors(inputs))
        state = [value for part in self.modules for value in _own_tensors(part)]
        gradients = torch.is_grad_enabled() and any(value.requires_grad for value in (*values, *state))
        key = (
            gradients,
            torch.is_autocast_enabled("cuda") and torch.get_autocast_dtype("cuda"),
            tuple((value.shape, value.dtype, value.device, value.requires_grad) for value in values),
            tuple((value.data_ptr(), value.requires_grad) for value in state),
            tuple(part.training for part in self.modules),
        )
        graphs = self.graphs.setdefault(key, [])
        if graphs is None:
            return self.function(*inputs)
        graph = next((graph for graph in graphs if not graph.pending()), None)
        if graph is None:
            graph = Graph(self.function, inputs, self.modules, self.recorder(), gradients)
            if graph.waits:
                self.graphs[key] = None
                _warn_of(graph.waits, "These steps run eagerly")
                return self.function(*inputs)
            graphs.append(graph)
        return graph(values)


class Graph:
    """One recording of a function for inputs of one kind, with its backward passes.

    For each set of outputs with a gradient, a backward pass is recorded when it is first needed.
    """

    def __init__(self, function: Callable, inputs: Any, modules: Sequence, recorder: Any, gradients: bool):
        self.recorder, self.gradients = recorder, gradients
        self.inputs = [value.detach().clone().requires_grad_(value.requires_grad) for value in tensors(inputs)]
        # Autograd does not track writes to these.
        self.written = [value.data for value in self.inputs]
        self.originals: list[Tensor] = []
        aliases = self._aliases(modules)
        given = enumerate((*self.inputs, *self.aliased))
        self.sources = [(place, value) for place, value in given if value.requires_grad]
        arguments = placed(tuple(inputs), iter(self.inputs))

        def run() -> Any:
            with _in_place(aliases), torch.set_grad_enabled(gradients):
                return function(*arguments)

        buffers = [value for part in modules for value in part._buffers.values() if value is not None]
        kept = [(value, value.detach().clone()) for value in buffers]
        self.outputs: list[Tensor] = []
        self.backwards: dict[tuple, tuple[list[Tensor], Callable]] = {}
        self.waits = recorder.waits(run)
        if not self.waits:
            self.replay = recorder.record(run)
        put_back(kept)
        self._holder: Callable = lambda: None

    def _aliases(self, modules: Sequence[nn.Module]) -> list[tuple[dict, dict]]:
        """Creates aliases of parameters and buffers, whose versions an optimiser's update does not increase."""
        known: dict[int, Tensor] = {}
        for part in modules:
            for value in part._parameters.values():
                if value is not None and id(value) not in known:
                    known[id(value)] = nn.Parameter(value.data, requires_grad=value.requires_grad)
                    self.originals.append(value)
            for value in part._buffers.values():
                if value is not None and id(value) not in known:
                    known[id(value)] = value.data
        self.aliased = [known[id(value)] for value in self.originals]
        tables = (table for part in modules for table in (part._parameters, part._buffers) if table)
        return [(table, {name: known.get(id(value)) for name, value in table.items()}) for table in tables]

    def pending(self) -> bool:
        """Returns True if the backward pass of the last call may still run."""
        holder = self._holder()
        if holder is None:
            return False
        try:
            return len(holder.saved_tensors) > 0
        except RuntimeError:  # after a backward pass that freed them
            return False

    def __call__(self, values: Sequence[Tensor]) -> Any:
        """Runs the function on other values."""
        out = Replay.apply(self, *values, *self.originals) if self.gradients else self.forward(values)
        return placed(self.layout, iter(out))

    @torch.no_grad()
    def forward(self, values: Sequence[Tensor]) -> list[Tensor]:
        """Replays the forward pass; returns copies of its outputs."""
        _copy(self.written, values)
        self.layout = self.replay()
        self.outputs = list(tensors(self.layout))
        return _copies(self.outputs)

    def backward(self, gradients: Sequence[Tensor | None]) -> list[Tensor | None]:
        """Replays the backward pass of the last call; returns the gradients of inputs and parameters."""
        used = tuple(place for place, value in enumerate(gradients) if value is not None)
        found: list[Tensor | None] = [None] * (len(self.inputs) + len(self.originals))
        if not used:
            return found
        given = [gradients[place] for place in used]
        if used not in self.backwards:
            self.backwards[used] = self._backward(used, given)
        along, replay = self.backwards[used]
        _copy(along, given)
        some = [(place, value) for place, value in replay() if value is not None]
        for (place, _), value in zip(some, _copies([value for _, value in some]), strict=True):
            found[place] = value
        return found

    def _backward(self, used: tuple[int, ...], given: Sequence[Tensor]) -> tuple[list[Tensor], Callable]:
        along = _copies(given)

        def run() -> list[tuple[int, Tensor | None]]:
            places, sources = zip(*self.sources, strict=True)
            ends = [self.outputs[place] for place in used]
            values = torch.autograd.grad(ends, sources, along, retain_graph=True, allow_unused=True)
            return list(zip(places, values, strict=True))

        waits = self.recorder.waits(run)
        if waits:
            _warn_of(waits, "The backward pass of these steps runs eagerly")
            return along, run
        return along, self.recorder.record(run)


class Replay(torch.autograd.Function):
    """Registers a recorded function with autograd."""

    @staticmethod
    def forward(ctx: Any, graph: Graph, *values: Tensor) -> tuple[Tensor, ...]:
        """Replays the forward pass."""
        ctx.graph = graph
        ctx.set_materialize_grads(False)
        out = graph.forward(values[: len(graph.inputs)])
        ctx.save_for_backward(out[0].new_empty(0))  # freed by the backward pass of this call
        graph._holder = weakref.ref(ctx)
        pairs = zip(out, graph.outputs, strict=True)
        ctx.mark_non_differentiable(*(copy for copy, value in pairs if not value.requires_grad))
        return tuple(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:
        """Replays the backward pass."""
        return None, *ctx.graph.backward(gradients)


def _own_tensors(part: nn.Module) -> Iterator[Tensor]:
    for table in (part._parameters, part._buffers):
        for value in table.values():
            if value is not None:
                yield value


@contextmanager
def _in_place(aliases: Sequence[tuple[dict, dict]]) -> Iterator[None]:
    """Replaces parameters and buffers by aliases."""
    before = [(table, dict(table)) for table, _ in aliases]
    try:
        for table, others in aliases:
            table.update(others)
        yield
    finally:
        for table, own in before:
            table.update(own)


def _copy(into: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    if into:
        torch._foreach_copy_(list(into), [value.detach() for value in values])


@torch.no_grad()
def _copies(values: Sequence[Tensor]) -> list[Tensor]:
    out = [torch.empty_like(value, requires_grad=False) for value in values]
    _copy(out, values)
    return out


def _warn_of(waits: Sequence[str], what: str) -> None:
    warnings.warn(
        f"{what}: a CUDA graph cannot record what waits for the device, at {', '.join(waits)}.",
        stacklevel=3,
    )


def strategy(chunk: int | None, options: dict[str, Any]) -> CompiledSteps | InTime:
    """Returns the strategy for the arguments of :meth:`torch_denkf.filters.Filter.compile`.

    Args:
        chunk: steps of a sequence in one graph; ``None`` for the strategy's default.
        options: of ``torch.compile``, or ``mode="graph"``, or ``mode="in time"``.

    Raises:
        ValueError: if ``chunk`` is negative or no whole number.
    """
    if chunk is not None:
        check_count("chunk", chunk, least=0, cure="It is a number of steps, or 0 for none")
    if options.get("mode") == "graph":
        return CapturedSteps(chunk, options)
    if options.get("mode") == "in time":
        return InTime(options)
    return CompiledSteps(4 if chunk is None else chunk, options)
