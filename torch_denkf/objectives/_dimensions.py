"""Objectives that score some dimensions of the state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from torch_denkf.filters import Filter
from torch_denkf.modules._tensors import check_dims
from torch_denkf.objectives._options import Scale
from torch_denkf.objectives._sequence import SequenceLoss


class DimensionsLoss(SequenceLoss):
    """Scores chosen dimensions of a belief that is several entries below one prefix.

    Args:
        filter: see :class:`SequenceLoss`, like ``weights`` and further arguments.
        weights: of the terms, by name.
        dims: state dimensions that count; all of the truth's by default. The belief may have more dimensions than the
            truth, which must then come first.
        state_scale: ``[len(dims)]``, or ``[S]`` without ``dims``. A dimension with infinite scale does not count.
        angles: state dimensions that are angles in radians, counted in the state, whichever ``dims`` are chosen.
        **kwargs: of :class:`SequenceLoss`.

    Raises:
        ValueError: on an unknown score, or a scale of another length than ``dims``.
    """

    @dataclass
    class _AcceptedKeys(SequenceLoss._AcceptedKeys):
        """What all objectives read, and the prefixes of belief and forecast."""

        belief: str = "belief"
        forecast: str = "forecast"

    default_keys = _AcceptedKeys

    def __init__(
        self,
        filter: Filter,
        weights: Mapping[str, float | None],
        *,
        dims: Sequence[int] | None = None,
        state_scale: Scale = None,
        angles: Sequence[int] = (),
        **kwargs,
    ):
        if dims is not None:
            check_dims("dims", dims, once=True)
            if state_scale is not None and len(state_scale) != len(dims):
                raise ValueError(f"state_scale has one entry for each of dims={list(dims)}; got {len(state_scale)}.")
            # As everything else, angles are counted in the state; errors are of the chosen dimensions alone.
            angles = [position for position, dim in enumerate(dims) if dim in angles]
        super().__init__(filter, weights, state_scale=state_scale, angles=angles, **kwargs)
        self.register_buffer("dims", None if dims is None else torch.tensor(list(dims)), persistent=False)
        self._last_dim = max(dims, default=-1) if dims is not None else -1

    def _errors(self, estimate: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Scaled errors of the dimensions that count.

        Raises:
            ValueError: if one of ``dims`` is beyond the true state's.
        """
        if self._last_dim >= target.shape[-1]:
            raise ValueError(
                f"dims={self.dims.tolist()} names dimension {self._last_dim}, but the true state "
                f"{self.tensor_keys.state!r} has {target.shape[-1]}, from 0; choose among these"
            )
        estimate = estimate[..., : target.shape[-1]]
        if self.dims is not None:
            estimate, target = estimate.index_select(-1, self.dims), target.index_select(-1, self.dims)
        return self._state_error(estimate, target)
