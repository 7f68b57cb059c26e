"""Exports a filter's step to a file: a package of torch, by default compiled ahead of time, or an ONNX model."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, get_args

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn

from torch_denkf.compilation import (
    check_same_numbers,
    clear_damaged_libraries,
    clear_full_cache,
    need_compiler,
    trace_below_autograd,
)
from torch_denkf.deployment.files import write_bytes
from torch_denkf.deployment.onnx_model import need_onnx, onnx_model
from torch_denkf.deployment.package import SIGNATURE, run_onnx
from torch_denkf.diagnosis import missing_entry
from torch_denkf.filters import Filter
from torch_denkf.submodel import Entries

Format = Literal["pt2", "onnx"]
_ONNX = "onnxruntime, or of what writes its models"


class _FlatStep(nn.Module):
    """A filter's step on plain tensors, in a fixed order."""

    def __init__(self, filter: Filter, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey], batch_size):
        super().__init__()
        self.filter, self.in_keys, self.out_keys, self.batch_size = filter, in_keys, out_keys, batch_size

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        """Takes one step."""
        written = self.filter.take_step(dict(zip(self.in_keys, values, strict=True)), self.batch_size)
        return tuple(written[key] for key in self.out_keys)


def export_step(
    filter: Filter,
    example: TensorDictBase,
    path: str | Path,
    *,
    out_keys: Sequence[NestedKey] = (),
    compiled: bool = True,
    format: Format = "pt2",
) -> Path:
    """Writes one step of a filter as a file with static shapes that runs without torch_denkf's training code.

    The file is a package of torch, or an `ONNX <https://onnx.ai>`_ model. onnxruntime runs such a model without torch,
    from Python, C++, C# or Java. A package has native code, or a graph that torch unpickles: loading it executes code,
    so treat it like a program. An ONNX model is data.

    A package draws its noise from torch's generator, unless ``example`` has the noise (see
    :meth:`~torch_denkf.filters.Filter.draw_noise`): then noise is an input, and the step is deterministic. In an ONNX
    model noise is always an input. Its names begin with ``noise.``. Floating inputs are standard normal, except
    ``uniform`` of a particle filter, which is uniform in [0, 1]; bytes are uniform, and booleans are True with
    probability one half.

    ONNX lacks matrix factorisations. Small ones are written out: readings of up to 4 components, and covariances of up
    to 6 x 6. Other unsupported operators raise an error with their name.

    A package cannot raise: after a reading that is not finite its belief stays NaN.

    Put a mask into ``example``, and set it to ``False`` for such readings. The package's result for the example is
    compared with the eager step, see :meth:`~torch_denkf.filters.Filter.compile`; with noise in the example
    elementwise, otherwise up to the effect of the noise.

    Args:
        filter: trained filter, on the device of the package.
        example: frame entries, and the optional inputs (mask, action, noise) of the step, for one step ``[*B]`` with
            the shapes and dtypes of the real ones. A missing belief is initialised.
        path: ends in ``.pt2``, or, for an ONNX model, in ``.onnx``.
        out_keys: further outputs, e.g. ``("info", "nis")``.
        compiled: compile ahead of time (AOTInductor; needs a C++ compiler here and the same kind of processor on the
            target). Otherwise the graph is written, which torch runs on any machine, more slowly. An ONNX model is such
            a graph.
        format: ``"pt2"`` for a package, ``"onnx"`` for an ONNX model.

    Returns:
        ``path``; :func:`torch_denkf.deployment.load_step` reads it.

    Raises:
        KeyError: if an entry that the step reads is missing.
        ValueError: if there is no such format, the path has another suffix, or the filter does not write one of
            ``out_keys``.
        ImportError: for an ONNX model without onnx, onnxscript or onnxruntime; the message names the extra.
        RuntimeError: if there is no C++ compiler, this torch cannot trace the step, ONNX lacks one of its operators, or
            the exported step differs from the eager one.
        OSError: if it cannot be written, as on a full disk; the message names the file and the free space.

    Example:
        >>> import tempfile
        >>> from tensordict import TensorDict
        >>> from torch_denkf.deployment import export_step, load_step
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> kf = KalmanFilter(one, one, process_noise_cov=one, noise_cov=one, mean=torch.zeros(1), cov=one)
        >>> folder = tempfile.TemporaryDirectory()
        >>> frame = TensorDict({"observation": torch.ones(1)})
        >>> step = load_step(export_step(kf, frame, f"{folder.name}/kf.pt2", compiled=False))
        >>> sorted(step.inputs), step.carry
        (['belief.cov', 'belief.mean', 'observation'], ['belief.mean', 'belief.cov'])
        >>> step({"observation": torch.ones(1), "belief.mean": torch.zeros(1), "belief.cov": one})["belief.mean"]
        tensor([0.6667])
    """
    if not isinstance(filter, Filter):
        raise TypeError(f"filter must be a torch_denkf Filter; got {type(filter).__name__}")
    if not isinstance(example, TensorDictBase):
        raise TypeError(f"example must be a tensordict of one step; got {type(example).__name__}")
    path = Path(path)
    if format not in get_args(Format):
        raise ValueError(f'format is "pt2" or "onnx"; got {format!r}')
    if path.suffix != f".{format}":
        raise ValueError(f"the path of a step in the format {format!r} ends in .{format}, got {path}")
    if format == "onnx":
        need_onnx()
    elif compiled:
        need_compiler()
    if any(example.get(key, None) is None for key in filter.carry_keys):
        example = filter.initialise(example.copy())
    structure = filter.structure
    inner = {filter.outer(key): key for key in (*structure.frame_keys, *structure.step_keys)}
    asked = [inner.get(key, key) for key in map(unravel_key, out_keys)]
    out_keys = list(dict.fromkeys([*structure.carry, *structure.belief, *asked]))
    unknown = [key for key in out_keys if key not in inner.values()]
    if unknown:
        raise ValueError(f"the filter does not write {unknown}; it writes {list(inner)}")
    entries = filter.entries_of(example, one_step=True)
    if format == "onnx":
        entries |= filter.draws.missing(entries, example.batch_size)
    in_keys = _inputs(filter, entries, example)
    # Contiguous clones: views would fix their strides in the graph.
    values = tuple(entries[key].clone(memory_format=torch.contiguous_format) for key in in_keys)
    inputs, outputs = [_name(key) for key in in_keys], [_name(key) for key in out_keys]
    kinds = [(list(value.shape), str(value.dtype)) for value in values]
    signature = json.dumps(
        {
            "inputs": [(name, *kind) for name, kind in zip(inputs, kinds, strict=True)],
            "outputs": outputs,
            "carry": [_name(key) for key in structure.carry],
        }
    )
    was_training = filter.training
    step = _FlatStep(filter.eval(), in_keys, out_keys, example.batch_size)
    package = io.BytesIO()  # torch's writer ends the process on a full disk
    try:
        with torch.no_grad():
            program = trace_below_autograd(step, values)
            if format == "onnx":
                package.write(onnx_model(program, inputs, outputs, signature))
                run, what, maker, instead = run_onnx(package.getvalue())[0], "ONNX model", _ONNX, 'format="pt2"'
            else:
                _write(program, package, signature, compiled)
                run, what, maker = _run(package, compiled), "compiled package", "torch's compiler"
                instead = "the graph, compiled=False, which is slower" if compiled else ""
            check_same_numbers(
                run,
                step,
                values,
                names=in_keys,
                outputs=out_keys,
                frames=[key for key in in_keys if key not in filter.belief_keys and key[0] != "noise"],
                what=what,
                maker=maker,
                cure="No file is written. "
                + (f"Write {instead}; and p" if instead else "P")
                + "lease report the filter.",
            )
    finally:
        filter.train(was_training)
    write_bytes(path, package.getbuffer())
    return path


def _write(program: torch.export.ExportedProgram, package: io.BytesIO, signature: str, compiled: bool) -> None:
    """Writes a package."""
    if compiled:
        clear_damaged_libraries()
        options = {"aot_inductor.metadata": {SIGNATURE: signature}}
        with clear_full_cache():
            torch._inductor.aoti_compile_and_package(program, package_path=package, inductor_configs=options)
    else:
        torch.export.save(program, package, extra_files={SIGNATURE: signature})


def _run(package: io.BytesIO, compiled: bool) -> Callable:
    """Returns the function that runs a package."""
    package.seek(0)
    if compiled:
        return torch._inductor.aoti_load_package(package)
    return torch.export.load(package).module(check_guards=False)


def _inputs(filter: Filter, entries: Entries, example: TensorDictBase) -> list[NestedKey]:
    """Lists the inputs of the step: the required ones, and the optional ones in the example."""
    structure = filter.structure
    keys = [*structure.needed, *structure.controls, *structure.carry]
    missing = [key for key in keys if key not in entries]
    if missing:
        raise missing_entry("the step", missing, example.keys(True, True), "This is what the example lacks.")
    return [*keys, *[key for key in entries if key not in keys and (key in structure.optional or key[0] == "noise")]]


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else ".".join(key)
