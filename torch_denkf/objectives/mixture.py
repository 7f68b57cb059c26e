"""The training objective of particle filters on sequences: the true state under a mixture around the particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase

from torch_denkf.filters import Filter
from torch_denkf.functional import crps_ensemble, crps_weighted, weighted_mean
from torch_denkf.objectives._sequence import SequenceLoss

__all__ = ["MixtureLoss"]


class MixtureLoss(SequenceLoss):
    r"""Scores a filter with weighted particles on sequences ``[*B, T]`` against the true states.

    The default score takes each particle for the centre of a Gaussian: :math:`-\log \sum_i w^i N(x; x^i,
    \mathrm{diag}(\sigma^2))`, which has a gradient where no particle is near the truth. It is the "M" of Kloss' dPF-M.
    The CRPS has no such width to choose, and makes filters comparable with those that were trained with
    :class:`~torch_denkf.objectives.DEnKFLoss`.

    ========================  =====================================================================================
    ``loss_state``            score of the belief against the true state
    ``loss_transition``       score of the forecast, with its weights, against the true state
    ``loss_mean``             squared error of the belief's weighted mean
    ``loss_sensor``           fair CRPS of the sensor's samples against the true observation; squared error where it
                              writes one sample or one reading
    ``loss_nll``              negative log-likelihood of the reading, nats; needs no true state
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied, so
    that their sum is the objective. Only elements that were stepped to count: the first of a sequence and those with
    ``is_init`` hold an initial belief. The sensor counts where it observed.

    Args:
        filter: the filter to train, e.g. :class:`~torch_denkf.filters.DPF`. Members without weights count alike.
        score: ``"mixture"``, in nats, or ``"crps"``, the weighted CRPS (not fair: there is no fair one with weights)
            in each dimension, averaged.
        component_std: :math:`\sigma`, a number or one for each of ``dims``, in units of ``state_scale``.
        state: weight of ``loss_state``.
        transition: weight of ``loss_transition``.
        mean: weight of ``loss_mean``.
        sensor: weight of ``loss_sensor``.
        nll: weight of ``loss_nll``.
        dims: state dimensions that count; all of the truth's by default. The belief may have more dimensions than the
            truth, which must then come first.
        state_scale: ``[len(dims)]``, or ``[S]`` without ``dims``: errors of the state are divided by it. A dimension
            with infinite scale does not count. The mixture is a density of the state in its own units all the same.
        observation_scale: ``[O]``, likewise, for the sensor.
        angles: state dimensions that are angles in radians; their errors are wrapped to [-pi, pi).
        detach_every: truncated back-propagation: steps after which the belief is detached.
        reduction: ``"mean"``, ``"sum"`` or ``"none"`` (``[*B, T]``, zero where an element does not count).

    Raises:
        ValueError: on an unknown score, a width that is not positive, or a scale of another length than ``dims``.
        KeyError: if an entry that a term needs is missing.

    Reference:
        Jonschkowski, Rastogi & Brock, "Differentiable particle filters", 2018, arXiv:1805.11122; Kloss, Martius &
        Bohg, "How to train your differentiable filter", 2021, arXiv:2012.14313.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import ParticleFilter
        >>> from torch_denkf.modules import ConstantNoise, GaussianLikelihood, GaussianPrior, LearnedTransition, Select
        >>> pf = ParticleFilter(
        ...     LearnedTransition(torch.nn.Linear(2, 2)),
        ...     None,
        ...     Select([0]),
        ...     GaussianLikelihood(sensor_key="y"),
        ...     noise=ConstantNoise([1.0], in_key="y"),
        ...     initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=16),
        ... )
        >>> loss = MixtureLoss(pf, mean=1.0)
        >>> sorted(loss(TensorDict({"y": torch.zeros(3, 9, 1), "state": torch.zeros(3, 9, 2)}, [3, 9])).keys())
        ['loss_mean', 'loss_state']
    """

    @dataclass
    class _AcceptedKeys(SequenceLoss._AcceptedKeys):
        """The entries that the loss reads.

        Attributes:
            state: true state ``[*B, T, S]``.
            target_observation: true observation ``[*B, T, O]``; where it is missing and the filter's observation
                model has no parameters, it is that model's observation of the true state.
            observed: mask ``[*B, T, 1]`` or ``[*B, T, O]``.
            belief: prefix of ``ensemble`` and ``log_weight`` of the belief.
            forecast: prefix of ``ensemble`` and ``log_weight`` of the forecast.
            sensor: the sensor's samples ``[*B, T, E, O]`` or readings ``[*B, T, O]``.
            log_likelihood: of the reading.
        """

        target_observation: NestedKey = "target_observation"
        belief: str = "belief"
        forecast: str = "forecast"
        sensor: NestedKey = ("sensor", "ensemble")

    default_keys = _AcceptedKeys
    SUPERVISED = ("state", "transition", "mean", "sensor")
    TERMS = ("state", "transition", "mean", "sensor", "nll")

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["mixture", "crps"] = "mixture",
        component_std: float | Sequence[float] | torch.Tensor = 1.0,
        state: float = 1.0,
        transition: float = 0.0,
        mean: float = 0.0,
        sensor: float = 0.0,
        nll: float = 0.0,
        dims: Sequence[int] | None = None,
        state_scale: Sequence[float] | torch.Tensor | None = None,
        observation_scale: Sequence[float] | torch.Tensor | None = None,
        angles: Sequence[int] = (),
        detach_every: int | None = None,
        reduction: Literal["mean", "sum", "none"] = "mean",
    ):
        if score not in ("mixture", "crps"):
            raise ValueError(f'score is "mixture" or "crps"; got {score!r}.')
        if dims is not None and state_scale is not None and len(state_scale) != len(dims):
            raise ValueError(f"state_scale has one entry for each of dims={list(dims)}; got {len(state_scale)}.")
        if dims is not None:
            # As everything else, angles are counted in the state; errors are of the chosen dimensions alone.
            angles = [position for position, dim in enumerate(dims) if dim in angles]
        super().__init__(
            filter,
            dict(zip(self.TERMS, (state, transition, mean, sensor, nll), strict=True)),
            state_scale=state_scale,
            angles=angles,
            detach_every=detach_every,
            reduction=reduction,
        )
        self.score = score
        self.register_scale("observation_scale", observation_scale)
        self.register_scale("component_std", component_std)
        if not (self.component_std > 0).all():
            raise ValueError(f"component_std is the width of each component, positive; got {component_std}.")
        if dims is not None and self.component_std.numel() not in (1, len(dims)):
            raise ValueError(f"component_std has one entry for each of dims={list(dims)}; got {component_std}.")
        self.register_buffer("dims", None if dims is None else torch.tensor(list(dims)), persistent=False)
        # Chosen here, once: a boolean index in forward would wait for the device.
        counting = None if self.state_scale is None else self.state_scale.isfinite().nonzero().flatten()
        self.register_buffer("counting", counting, persistent=False)

    # ------------------------------------------------------------------------------- terms: value and mask [*B, T]

    def _state(self, tensordict, out):
        return self._score(out, self.tensor_keys.belief, tensordict), None

    def _transition(self, tensordict, out):
        return self._score(out, self.tensor_keys.forecast, tensordict), None

    def _mean(self, tensordict, out):
        particles, log_weights = self._particles(out, self.tensor_keys.belief)
        return self._errors(weighted_mean(particles, log_weights), self._true_state(tensordict)).square().mean(-1), None

    def _sensor(self, tensordict, out):
        observed = tensordict.get(self.tensor_keys.observed, None)
        samples, target = self._entry(out, self.tensor_keys.sensor), self._true_observation(tensordict)
        if samples.ndim == target.ndim:
            samples = samples.unsqueeze(-2)
        errors = samples - target.unsqueeze(-2)
        errors = errors if self.observation_scale is None else errors / self.observation_scale
        mask = torch.ones_like(target[..., 0], dtype=torch.bool) if observed is None else observed.all(-1)
        if samples.shape[-2] == 1:
            return errors.squeeze(-2).square().mean(-1), mask
        return crps_ensemble(errors, torch.zeros_like(errors[..., 0, :])).mean(-1), mask

    # ------------------------------------------------------------------------------------------------------ helpers

    def _particles(self, out: TensorDictBase, prefix: str) -> tuple[torch.Tensor, torch.Tensor]:
        particles = self._entry(out, (prefix, "ensemble"))
        log_weights = out.get((prefix, "log_weight"), None)
        if log_weights is None:
            log_weights = torch.full_like(particles[..., 0], -math.log(particles.shape[-2]))
        return particles, log_weights

    def _errors(self, estimate: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Scaled errors of the dimensions that count."""
        estimate = estimate[..., : target.shape[-1]]
        if self.dims is not None:
            estimate, target = estimate.index_select(-1, self.dims), target.index_select(-1, self.dims)
        errors = self._state_error(estimate, target)
        return errors if self.counting is None else errors.index_select(-1, self.counting)

    def _score(self, out: TensorDictBase, prefix: str, tensordict: TensorDictBase) -> torch.Tensor:
        particles, log_weights = self._particles(out, prefix)
        errors = self._errors(particles, self._true_state(tensordict).unsqueeze(-2))
        if self.score == "crps":
            return crps_weighted(errors, log_weights, torch.zeros_like(errors[..., 0, :])).mean(-1)
        std, units = self.component_std, 0.0
        if self.counting is not None:
            std = std.index_select(-1, self.counting) if std.numel() > 1 else std
            units = self.state_scale[self.counting].log().sum()
        std = std.expand(errors.shape[-1])
        log_density = log_weights - 0.5 * (errors / std).square().sum(-1)
        constant = std.log().sum() + 0.5 * math.log(2 * math.pi) * errors.shape[-1] + units
        return constant - torch.logsumexp(log_density, -1)

    def _true_observation(self, tensordict: TensorDictBase) -> torch.Tensor:
        key = self.tensor_keys.target_observation
        target = tensordict.get(key, None)
        if target is not None:
            return target
        models = [part for part in self.filter.module.modules() if hasattr(part, "observe")]
        if not models or any(True for _ in models[0].parameters()):
            raise KeyError(
                f"loss_sensor needs the true observation in {key!r}, because the filter has no known observation "
                "model with an observe() method. Add the entry, rename it with set_keys(target_observation=...), or "
                "set the weight sensor=0."
            )
        return models[0].observe(self._true_state(tensordict))
