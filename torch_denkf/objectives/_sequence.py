"""What the objectives of whole filters share: a filter run over sequences, and the likelihood of its readings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torch_denkf.filters import Filter
from torch_denkf.filters._one_sequence import refuse_unmarked_slices
from torch_denkf.objectives._readings import ReadingsLoss


class SequenceLoss(ReadingsLoss):
    """Filters sequences ``[*B, T]`` and scores what it writes.

    The terms ``nll``, ``sensor`` and ``observation`` are here. By default those elements count that were stepped to;
    the first of a sequence and those with ``is_init`` hold an initial belief. Slices in a flat ``[N]``, as torchrl's
    ``SliceSampler`` returns them, must be marked, see :func:`refuse_unmarked_slices`.

    Args:
        filter: see :class:`FilterLoss`, like ``weights`` and further arguments.
        weights: of the terms, by name.
        detach_every: truncated back-propagation: steps after which the belief is detached.
        **kwargs: of :class:`FilterLoss`.

    Raises:
        ValueError: on an unknown score, or a scale that is not positive.
    """

    @dataclass
    class _AcceptedKeys(ReadingsLoss._AcceptedKeys):
        """What all objectives read, and ``log_likelihood``, that of the innovation."""

        log_likelihood: NestedKey = ("info", "log_likelihood")

    default_keys = _AcceptedKeys
    #: Terms that need the true state.
    SUPERVISED: Sequence[str] = ("state", "transition", "sensor")

    def __init__(
        self, filter: Filter, weights: Mapping[str, float | None], *, detach_every: int | None = None, **kwargs
    ):
        super().__init__(filter, weights, **kwargs)
        self.detach_every = detach_every

    def _needed(self) -> list[NestedKey]:
        """What the filter must find beside its belief, and the true state."""
        structure = self.filter.structure
        return [*structure.needed, *structure.controls] + [self.tensor_keys.state] * (
            not set(self.SUPERVISED).isdisjoint(self.weights)
        )

    def _run(self, tensordict: TensorDictBase) -> TensorDictBase:
        refuse_unmarked_slices(tensordict, self.filter.init_key)
        return self.filter.inside(self.filter.sequence(tensordict.copy(), detach_every=self.detach_every))

    def _counts(self, tensordict: TensorDictBase) -> Tensor:
        return self.filter.stepped(tensordict)

    def _nll(self, tensordict, out):
        key = self.tensor_keys.log_likelihood
        # Of several analyses, each with its own readings, the likelihoods multiply.
        keys = self.filter.structure.likelihoods if key == self._AcceptedKeys.log_likelihood else []
        first, *others = [self._entry(out, key) for key in keys or [key]]
        return -sum(others, first).squeeze(-1), None
