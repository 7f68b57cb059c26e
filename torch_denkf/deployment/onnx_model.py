"""A traced step as an ONNX model, which onnxruntime runs without torch."""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec

import torch

from torch_denkf.deployment.package import NEEDS_ONNX, SIGNATURE
from torch_denkf.functional.kernels.small_system import LARGEST_ELIMINATED, LARGEST_FACTOR

__all__ = ["need_onnx", "onnx_model"]

_OTHERWISE = 'Or write format="pt2", which holds all operators of torch.'
#: Parts of operators' names, and alternatives without these operators.
_CURES = {
    "eigh": 'The scheme "etkf" needs it, and a FusedFilter of an ensemble: choose "perturbed", "sakov" or "sensor".',
    "cholesky|triangular": (
        f"It is written out for readings of up to {LARGEST_ELIMINATED} numbers, and for factors of up to "
        f"{LARGEST_FACTOR} x {LARGEST_FACTOR}: read more numbers in parts, each a FusedSensor of a FusedFilter."
    ),
    "searchsorted": 'Particles are resampled with it: choose resampling="transport".',
    "igamma": "An InnovationMonitor needs it: write the filter that is monitored.",
}


def need_onnx() -> None:
    """Checks that the packages for ONNX models are installed.

    Raises:
        ImportError: if one is missing; the message names it and the extra.
    """
    missing = [name for name in ("onnx", "onnxscript", "onnxruntime") if find_spec(name) is None]
    if missing:
        raise ImportError(f"{', '.join(missing)}: {NEEDS_ONNX}")


def onnx_model(
    program: torch.export.ExportedProgram, inputs: Sequence[str], outputs: Sequence[str], signature: str
) -> bytes:
    """Writes a traced step as an ONNX model.

    Args:
        program: the step, without automatic differentiation.
        inputs: names of its inputs, in order.
        outputs: names of its outputs, in order. Outputs with the name of an input get the prefix ``next.`` in the
            model.
        signature: description, kept in the model's metadata.

    Returns:
        The model; weights are inside.

    Raises:
        RuntimeError: if the step draws random numbers, or has an operator that ONNX lacks; the message names it.
    """
    for node in program.graph.nodes:
        if torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ()):
            raise RuntimeError(
                f"The step draws random numbers itself, with {node.target}. In an ONNX model all noise is an input: "
                "give the filter process_noise=, or let your module's draw_noise() draw."
            )
    named = [f"next.{name}" if name in inputs else name for name in outputs]  # names are unique in a model
    try:
        with _quiet():
            written = torch.onnx.export(
                program, (), dynamo=True, verbose=False, input_names=list(inputs), output_names=named
            )
    except torch.onnx.OnnxExporterError as error:
        raise RuntimeError(_refusal(error)) from error
    assert written is not None  # with dynamo=True
    model = written.model
    graph = model.graph
    graph.metadata_props.clear()
    for node in graph.all_nodes():  # names of files and lines, six times as large as the rest
        node.metadata_props.clear()
    for value in (*graph.inputs, *graph.outputs, *graph.initializers.values()):
        value.metadata_props.clear()
    model.metadata_props[SIGNATURE] = signature
    return written.model_proto.SerializeToString()


def _refusal(error: BaseException) -> str:
    """Returns the message for an error of the exporter."""
    reason = " ".join(str(error).split())
    cause: BaseException | None = error
    while cause is not None:
        found = re.search(r"OpOverload\(op='([\w.]+)'", str(cause))
        if found and "No ONNX function" in str(cause):
            name = found[1]
            cures = [cure for part, cure in _CURES.items() if re.search(part, name)]
            return " ".join([f"ONNX has no operator for {name}, which this step uses.", *cures, _OTHERWISE])
        cause = cause.__cause__
    return f"torch {torch.__version__} cannot write this step as an ONNX model ({reason[:500]}). {_OTHERWISE}"


@contextmanager
def _quiet() -> Iterator[None]:
    """Silences the exporter's messages about unused packages, and about its own code."""
    loggers = [logging.getLogger(name) for name in ("torch.onnx", "onnx_ir", "onnxscript")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
