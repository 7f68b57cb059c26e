"""Accumulates gradients of linear layers over the steps of a sequence: one product at the end instead of one per step.

In each step of a backward pass a layer would launch a product for its weight, a sum over rows for its bias, and an
addition of each to the accumulated gradients. On a GPU these launches are a third of a training step. Here each step
stores its factors, and the layer multiplies those of all steps at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import local

import torch
from torch import Tensor, nn

from torch_denkf.modules.stochastic import LAYERS

__all__ = ["shared", "sharing"]

#: Stored gradient elements after which a layer multiplies them: 128 MiB in single precision.
LARGEST_KEPT = 2**25


class _State(local):
    layers: dict[nn.Module, tuple[Tensor, _Kept]] | None = None


_STATE = _State()


@contextmanager
def sharing() -> Iterator[None]:
    """Enables accumulation of layer gradients for the steps inside."""
    if shared not in LAYERS:
        LAYERS.append(shared)
    before, _STATE.layers = _STATE.layers, {}
    try:
        yield
    finally:
        _STATE.layers = before


def shared(layer: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Returns a linear layer with accumulated gradients; returns other layers unchanged."""
    if not isinstance(layer, nn.Linear) or type(layer) is not nn.Linear or _STATE.layers is None:
        return layer
    if not torch.is_grad_enabled() or torch._C._are_functorch_transforms_active():
        return layer
    trained = layer.weight.requires_grad and layer.bias is not None and layer.bias.requires_grad
    if not trained or layer._forward_hooks or layer._forward_pre_hooks:
        return layer
    if layer not in _STATE.layers:
        kept = _Kept()
        _STATE.layers[layer] = _Gather.apply(layer.weight, layer.bias, kept), kept
    token, kept = _STATE.layers[layer]
    weight, bias = layer.weight.detach(), layer.bias.detach()
    return lambda x: _Product.apply(x, weight, bias, token, kept)


class _Kept:
    """Stored inputs and output gradients of a layer, and the sum of earlier products."""

    def __init__(self):
        self.pairs: list[tuple[Tensor, Tensor]] = []
        self.count, self.total = 0, None

    def add(self, x: Tensor, gradient: Tensor) -> None:
        self.pairs.append((x.reshape(-1, x.shape[-1]), gradient.reshape(-1, gradient.shape[-1])))
        self.count += gradient.numel()
        if self.count > LARGEST_KEPT:
            self.total = self.taken()

    def taken(self) -> tuple[Tensor, Tensor] | None:
        """Returns the gradients of weight and bias, and resets them."""
        total, pairs = self.total, self.pairs
        self.pairs, self.count, self.total = [], 0, None
        if not pairs:
            return total
        x, gradient = (torch.cat(rows) if len(pairs) > 1 else rows[0] for rows in zip(*pairs, strict=True))
        found = gradient.mT @ x, gradient.sum(0)
        return found if total is None else (total[0] + found[0], total[1] + found[1])


class _Gather(torch.autograd.Function):
    """A node whose backward pass runs after those of all products of its output."""

    @staticmethod
    def forward(ctx, weight: Tensor, bias: Tensor, kept: _Kept) -> Tensor:
        ctx.kept = kept
        return weight.new_empty(0)

    @staticmethod
    def backward(ctx, _: Tensor):
        return *(ctx.kept.taken() or (None, None)), None


class _Product(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor, bias: Tensor, token: Tensor, kept: _Kept) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.kept, ctx.gather = kept, token.grad_fn
        return torch.nn.functional.linear(x, weight, bias)

    @staticmethod
    def backward(ctx, gradient: Tensor):
        x, weight = ctx.saved_tensors
        if torch._C._will_engine_execute_node(ctx.gather):  # else no gradient of the layer is needed
            ctx.kept.add(x, gradient)
        return gradient @ weight if ctx.needs_input_grad[0] else None, None, None, None, None
