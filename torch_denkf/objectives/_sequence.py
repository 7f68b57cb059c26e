"""What the objectives of filters share: a filter run over sequences, weighted terms, masks, scales and angles."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase, dispatch
from torchrl.objectives import LossModule

from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble, wrap_angles


class SequenceLoss(LossModule):
    """Filters sequences ``[*B, T]`` and returns weighted terms, ``loss_<name>`` for each weight that is not zero.

    A subclass writes a method ``_<name>(tensordict, out)`` for each of its terms, which returns its value
    ``[*B, T]`` and which elements count (``None``: those that were stepped to; the first of a sequence and those with
    ``is_init`` hold an initial belief). The terms ``nll`` and ``sensor`` are here.

    Args:
        filter: the filter to train; its parameters are the loss's.
        weights: of the terms, by name.
        score: one of the class's ``SCORES``.
        state_scale: ``[S]``; errors of the state are divided by it. A dimension with infinite scale does not count.
        observation_scale: ``[O]``, likewise, for observations.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        detach_every: truncated back-propagation: steps after which the belief is detached.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B, T]``, zero where an element does not count).

    Raises:
        ValueError: on an unknown score.
    """

    @dataclass
    class _AcceptedKeys:
        """The entries that all objectives read: truth, mask, the sensor's samples, the innovation's likelihood."""

        state: NestedKey = "state"
        target_observation: NestedKey = "target_observation"
        observed: NestedKey = "observed"
        sensor: NestedKey = ("sensor", "ensemble")
        log_likelihood: NestedKey = ("info", "log_likelihood")

    default_keys = _AcceptedKeys
    #: Terms that need the true state.
    SUPERVISED: Sequence[str] = ("state", "transition", "sensor")
    SCORES: Sequence[str] = ()

    def __init__(
        self,
        filter: Filter,
        weights: Mapping[str, float],
        *,
        score: str,
        state_scale: Sequence[float] | torch.Tensor | None = None,
        observation_scale: Sequence[float] | torch.Tensor | None = None,
        angles: Sequence[int] = (),
        detach_every: int | None = None,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ):
        if score not in self.SCORES:
            *others, last = (f'"{name}"' for name in self.SCORES)
            raise ValueError(f"score is {', '.join(others)} or {last}; got {score!r}.")
        super().__init__()
        self.filter, self.score, self.reduction = filter, score, reduction
        self.weights = {name: weight for name, weight in weights.items() if weight}
        self.angles, self.detach_every = list(angles), detach_every
        self.register_scale("state_scale", state_scale)
        self.register_scale("observation_scale", observation_scale)
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

    # ------------------------------------------------------------------------------- terms: value and mask [*B, T]

    def _nll(self, tensordict, out):
        return -self._entry(out, self.tensor_keys.log_likelihood).squeeze(-1), None

    def _sensor(self, tensordict, out):
        observed = tensordict.get(self.tensor_keys.observed, None)
        target = self._true_observation(tensordict)
        samples = self._entry(out, self.tensor_keys.sensor)
        if samples.ndim == target.ndim:
            samples = samples.unsqueeze(-2)
        mask = torch.ones_like(target[..., 0], dtype=torch.bool) if observed is None else observed.all(-1)
        return self._score_samples(self._observation_error(samples, target.unsqueeze(-2))), mask

    # ----------------------------------------------------------------------------------------------------- errors

    def _score_samples(self, errors: torch.Tensor) -> torch.Tensor:
        """Score of samples that are off by ``[*, E, N]``: fair CRPS, or the squared error of their mean."""
        if self.score == "mse" or errors.shape[-2] == 1:
            return errors.mean(-2).square().mean(-1)
        return crps_ensemble(errors, torch.zeros_like(errors[..., 0, :])).mean(-1)

    def _state_error(self, estimate: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Scaled errors of states ``[*, S]``, angles wrapped."""
        errors = wrap_angles(estimate - target, self.angles)
        return errors if self.state_scale is None else errors / self.state_scale

    def _observation_error(self, estimate: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Scaled errors of observations ``[*, O]``."""
        errors = estimate - target
        return errors if self.observation_scale is None else errors / self.observation_scale

    # ------------------------------------------------------------------------------------------------ what counts

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

    # ---------------------------------------------------------------------------------------------------- entries

    def _true_state(self, tensordict: TensorDictBase) -> torch.Tensor:
        return self._entry(tensordict, self.tensor_keys.state)

    def _true_observation(self, tensordict: TensorDictBase) -> torch.Tensor:
        key = self.tensor_keys.target_observation
        target = tensordict.get(key, None)
        if target is not None:
            return target
        model = self._observation_model()
        if model is None or any(True for _ in model.parameters()):
            why = (
                "has no observation model with an observe() method" if model is None else "learns its observation model"
            )
            raise KeyError(
                f"loss_sensor needs the true observation in {key!r}, because the filter {why}. Add the entry, rename "
                "it with set_keys(target_observation=...), or set the weight sensor=0."
            )
        return model.observe(self._true_state(tensordict))

    def _observation_model(self) -> TensorDictModuleBase | None:
        """The filter's model of what it observes in a state, which may be a part of its analysis."""
        parts = (part for module in self.filter.update_modules for part in module.modules())
        return next((part for part in parts if hasattr(part, "observe")), None)

    def _entry(self, tensordict: TensorDictBase, key: NestedKey) -> torch.Tensor:
        value = tensordict.get(key, None)
        if value is None:
            present = ", ".join(sorted(map(str, tensordict.keys(True, True))))
            raise KeyError(
                f"{type(self).__name__} reads {key!r}, which is missing; there are {present}. Rename it with "
                "loss.set_keys(...)."
            )
        return value
