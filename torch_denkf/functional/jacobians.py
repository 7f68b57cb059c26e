"""Values and Jacobians of networks of linear layers and activations: products of matrices, in one forward pass."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence, Set
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = ["jacobian_of_layers", "jacobian_of_network"]


#: Derivatives of activations as functions of the layer, its input and its output.
_SLOPES: dict[type, Callable[..., Tensor]] = {
    nn.ReLU: lambda layer, x, y: x > 0,
    nn.LeakyReLU: lambda layer, x, y: torch.where(x > 0, 1.0, torch.full_like(x, layer.negative_slope)),
    nn.ELU: lambda layer, x, y: torch.where(x > 0, 1.0, y + layer.alpha),
    nn.Tanh: lambda layer, x, y: 1 - y * y,
    nn.Sigmoid: lambda layer, x, y: y * (1 - y),
    nn.SiLU: lambda layer, x, y: y + (1 - y) * x.sigmoid(),
    nn.Softplus: lambda layer, x, y: torch.where(x * layer.beta > layer.threshold, 1.0, (x * layer.beta).sigmoid()),
}


def jacobian_of_network(network: nn.Module, x: Tensor, size: int) -> tuple[Tensor, Tensor] | None:
    """Returns a network's output for ``x`` and its Jacobian by the first inputs, if that is a product of matrices.

    Both can be differentiated. If a network has its own method ``jacobian(x, size)``, this is called, unless a
    subclass overrides ``forward`` but not the Jacobian.

    Args:
        network: linear layers and activations, one after the other in ``nn.Sequential``.
        x: ``[*, N]``.
        size: S, the number of inputs with respect to which the Jacobian is taken.

    Returns:
        ``[*, M]`` and ``[*, M, S]``, or ``[M, S]`` if it is constant; ``None`` if the network has another kind of
        layer, or a layer has hooks.

    Example:
        >>> net = nn.Sequential(nn.Linear(2, 3), nn.Tanh(), nn.Linear(3, 1))
        >>> value, jacobian = jacobian_of_network(net, torch.zeros(5, 2), 2)
        >>> value.shape, jacobian.shape
        (torch.Size([5, 1]), torch.Size([5, 1, 2]))
    """
    own = getattr(network, "jacobian", None)
    if own is not None:
        return None if _hooked(network) or is_older(type(network), {"jacobian"}, {"forward"}) else own(x, size)
    return jacobian_of_layers(list(_flat(network)), x, size)


def jacobian_of_layers(
    layers: Sequence[Any], x: Tensor, size: int, linear: tuple[type, ...] = (nn.Linear,)
) -> tuple[Tensor, Tensor] | None:
    """Works like :func:`jacobian_of_network`, for layers in order; those of types ``linear`` are W x + b."""
    if any(not (type(layer) in linear or type(layer) in _SLOPES) or _hooked(layer) for layer in layers):
        return None
    identity = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)[:size]
    rows: Tensor | None = None  # the Jacobian's transpose, [*, S, H]
    for layer in layers:
        if type(layer) in linear:
            rows = layer.weight[:, :size].mT if rows is None else rows @ layer.weight.mT
            x = F.linear(x, layer.weight, layer.bias)
            continue
        read, rows = x, identity if rows is None else rows
        x = layer(read.clone() if getattr(layer, "inplace", False) else read)
        rows = rows * _SLOPES[type(layer)](layer, read, x).unsqueeze(-2)
    return x, (identity if rows is None else rows).mT


def is_older(kind: type, names: Set[str], others: Set[str]) -> bool:
    """Tells whether a class inherits ``names`` from a higher base than ``others``, or has none of ``names``."""
    return next((not vars(base).keys() & names for base in kind.__mro__ if vars(base).keys() & (names | others)), False)


def _flat(network: nn.Module) -> Iterator[nn.Module]:
    """Yields the layers of sequences, nested ones included, except for the identity."""
    if type(network) is nn.Sequential and not _hooked(network):
        for layer in network:
            yield from _flat(layer)
    elif type(network) is not nn.Identity or _hooked(network):
        yield network


def _hooked(layer: nn.Module) -> bool:
    """Tells whether a call does more than the class's forward."""
    hooks = layer._forward_hooks or layer._forward_pre_hooks or layer._backward_hooks or layer._backward_pre_hooks
    return bool(hooks) or "forward" in vars(layer)
