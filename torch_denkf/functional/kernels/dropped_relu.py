"""ReLU and dropout in one function, whose backward pass needs only the result."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf.functional.kernels.small_system import on_gpu

__all__ = ["dropped_relu"]


def dropped_relu(x: Tensor, factor: Tensor, rate: float) -> Tensor:
    """Applies ReLU, then dropout: ``relu(x) * factor``.

    Where the result is positive, its derivative is 1 / (1 - rate); elsewhere it is zero. The next layer stores the
    result anyway, so no masks are stored for the backward pass; in a chunk compiled by inductor (torch 2.13, on a
    processor) storing them costs more than the matrix products.

    Args:
        x: output of a linear layer, any shape.
        factor: 0 or 1 / (1 - rate), of the shape of ``x``, from
            :func:`~torch_denkf.functional.kernels.random_bits.dropout_factor`.
        rate: drop probability in [0, 1).

    Returns:
        The hidden layer, of the shape of ``x``.

    Example:
        >>> dropped_relu(torch.tensor([-1.0, 1.0, 1.0]), torch.tensor([2.0, 2.0, 0.0]), 0.5)
        tensor([0., 2., 0.])
    """
    if torch.is_grad_enabled() and x.requires_grad:
        function = _DroppedReLU if torch.compiler.is_compiling() else _WithForwardMode
        return function.apply(x, factor, 1 / (1 - rate))
    return (x * factor).relu_()


class _DroppedReLU(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, factor: Tensor, kept: float) -> Tensor:
        # Not in place while tracing: on CUDA the saved result lost its gradient (torch 2.11).
        return (x * factor).relu() if torch.compiler.is_compiling() else (x * factor).relu_()

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: Tensor) -> None:
        ctx.kept = inputs[2]
        ctx.save_for_backward(output)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple:
        (output,) = ctx.saved_tensors
        if on_gpu(output):
            return torch.ops.aten.threshold_backward(gradient, output, 0) * ctx.kept, None, None
        return gradient * (output.sign() * ctx.kept), None, None


class _WithForwardMode(_DroppedReLU):
    """Adds forward mode, in a separate class because dynamo rejects functions that have a ``jvp``."""

    @staticmethod
    def setup_context(ctx, inputs: tuple, output: Tensor) -> None:
        _DroppedReLU.setup_context(ctx, inputs, output)
        ctx.save_for_forward(output)

    @staticmethod
    def jvp(ctx, tangent: Tensor, *_) -> Tensor:
        (output,) = ctx.saved_tensors
        return tangent * (output.sign() * ctx.kept)
