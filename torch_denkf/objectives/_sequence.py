"""What the objectives of filters share: a filter run over sequences, weighted terms, masks, scales and angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import dispatch
from torchrl.objectives import LossModule

from torch_denkf.filters import Filter


class SequenceLoss(LossModule):
    """Filters sequences ``[*B, T]`` and returns weighted terms, ``loss_<name>`` for each weight that is not zero.

    A subclass writes a method ``_<name>(tensordict, out)`` for each of its terms, which returns its value
    ``[*B, T]`` and which elements count (``None``: those that were stepped to; the first of a sequence and those with
    ``is_init`` hold an initial belief).

    Args:
        filter: the filter to train; its parameters are the loss's.
        weights: of the terms, by name.
        state_scale: ``[S]``; errors of the state are divided by it. A dimension with infinite scale does not count.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        detach_every: truncated back-propagation: steps after which the belief is detached.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B, T]``, zero where an element does not count).
    """

    @dataclass
    class _AcceptedKeys:
        """The entries that all objectives read: the true state, the mask, the likelihood of the innovation."""

        state: NestedKey = "state"
        observed: NestedKey = "observed"
        log_likelihood: NestedKey = ("info", "log_likelihood")

    default_keys = _AcceptedKeys
    #: Terms that need the true state.
    SUPERVISED: Sequence[str] = ("state",)

    def __init__(
        self,
        filter: Filter,
        weights: Mapping[str, float],
        *,
        state_scale: Sequence[float] | torch.Tensor | None = None,
        angles: Sequence[int] = (),
        detach_every: int | None = None,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ):
        super().__init__()
        self.filter, self.reduction = filter, reduction
        self.weights = {name: weight for name, weight in weights.items() if weight}
        self.angles, self.detach_every = list(angles), detach_every
        self.register_scale("state_scale", state_scale)
        self.out_keys = [f"loss_{name}" for name in self.weights]

    def register_scale(self, name: str, scale: Sequence[float] | torch.Tensor | None) -> None:
        """Keeps a scale as a buffer, or ``None``."""
        scale = None if scale is None else torch.as_tensor(scale, dtype=torch.get_default_dtype())
        self.register_buffer(name, scale)

    @property
    def functional(self) -> bool:
        """The filter keeps its parameters."""
        return False

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the filter reads beside its belief, and the true state."""
        reads = [key for key in map(unravel_key, self.filter.in_keys) if key not in self.filter.carry_keys]
        return reads + [self.tensor_keys.state] * (not set(self.SUPERVISED).isdisjoint(self.weights))

    @in_keys.setter
    def in_keys(self, value) -> None:
        raise AttributeError("in_keys follow from the filter; rename the state with set_keys(state=...).")

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        pass

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Filters the sequence and returns the weighted terms; ``tensordict`` is left as it is."""
        out = self.filter.sequence(tensordict.copy(), detach_every=self.detach_every)
        counts = self._stepped(tensordict)
        losses = TensorDict({}, batch_size=[])
        for name, weight in self.weights.items():
            term, mask = getattr(self, f"_{name}")(tensordict, out)
            if term.ndim:
                term = self._reduce_term(term, counts if mask is None else mask, tensordict)
            losses[f"loss_{name}"] = weight * term
        return losses

    def _nll(self, tensordict, out):
        return -self._entry(out, self.tensor_keys.log_likelihood).squeeze(-1), None

    def _state_error(self, estimate: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Scaled errors of states ``[*, S]``, angles wrapped."""
        errors = estimate - target
        if self.angles:
            wrapped = torch.remainder(errors + pi, 2 * pi) - pi
            is_angle = torch.zeros(errors.shape[-1], dtype=torch.bool, device=errors.device)
            is_angle[self.angles] = True
            errors = torch.where(is_angle, wrapped, errors)
        return errors if self.state_scale is None else errors / self.state_scale

    def _stepped(self, tensordict: TensorDictBase) -> torch.Tensor:
        """``False`` for the first element and for those that start anew, ``[*B, T]``."""
        stepped = torch.ones(tensordict.batch_size, dtype=torch.bool, device=tensordict.device)
        stepped[..., 0] = False
        starts = self.filter._starts(tensordict)
        return stepped if starts is None else stepped & ~starts.reshape(tensordict.batch_size)

    def _reduce_term(self, term: torch.Tensor, mask: torch.Tensor, tensordict: TensorDictBase) -> torch.Tensor:
        if self.reduction == "none":
            return self._reduce_loss(torch.where(mask, term, torch.zeros_like(term)), tensordict)
        return self._reduce_loss(term, tensordict, mask=mask)

    def _true_state(self, tensordict: TensorDictBase) -> torch.Tensor:
        return self._entry(tensordict, self.tensor_keys.state)

    def _entry(self, tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
        value = tensordict.get(key, None)
        if value is None:
            present = ", ".join(sorted(map(str, tensordict.keys(True, True))))
            raise KeyError(
                f"{type(self).__name__} reads {key!r}, which is missing; there are {present}. Rename it with "
                "loss.set_keys(...)."
            )
        return value
