"""Traces a module to a graph without autograd, for torch.export's packages."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["trace_below_autograd"]


def trace_below_autograd(module: nn.Module, values: tuple[Tensor, ...]) -> torch.export.ExportedProgram:
    """Records a module's operations after automatic differentiation.

    ``torch.export.export`` records above it. There a Jacobian inside the module becomes the constant of the example,
    and inductor compiles an LSTM cell wrongly (torch 2.13), without an error.

    Args:
        module: maps tensors to a tuple of tensors.
        values: examples of its inputs, which fix the shapes.

    Raises:
        RuntimeError: if this torch cannot trace in this way.
    """
    try:
        from torch.export._trace import _export
    except ImportError as error:
        raise RuntimeError(
            f"torch {torch.__version__} does not trace a step below automatic differentiation ({error}); install "
            "torch 2.13 to export a step."
        ) from error
    return _export(module, values, strict=False, pre_dispatch=False)
