"""Objectives of one part of a filter: they train that part, and nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from torch import nn

from torch_denkf.objectives._base import FilterLoss


class PartLoss(FilterLoss):
    """Has the parameters of some of the filter's modules; a subclass names them in :meth:`_trained`.

    The whole filter is kept, so that it follows the loss to another device, and its names stay in the state dict.
    """

    def named_parameters(self, prefix: str = "", recurse: bool = True) -> Iterator[tuple[str, nn.Parameter]]:
        """The parameters of the part, with their names in the filter."""
        own = {id(parameter) for module in self._trained() for parameter in module.parameters()} if recurse else set()
        yield from ((name, value) for name, value in super().named_parameters(prefix, recurse) if id(value) in own)

    def _trained(self) -> Iterable[nn.Module]:
        """The modules of the part."""
        raise NotImplementedError
