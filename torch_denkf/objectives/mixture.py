"""The training objective of particle filters on sequences: the true state under a mixture around the particles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Unpack

import torch
from tensordict import NestedKey, TensorDictBase

from torch_denkf.filters import Filter
from torch_denkf.functional import weighted_mean
from torch_denkf.objectives._base import BELIEFS
from torch_denkf.objectives._labels import Labels
from torch_denkf.objectives._options import SequenceOptions
from torch_denkf.objectives._scores import mean_of, score_mixture
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
    ``loss_sensor``           fair CRPS of the sensor's samples against the true observation, which is the absolute
                              error of one sample or one reading
    ``loss_nll``              negative log-likelihood of the reading, nats; needs no true state
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied, so
    that their sum is the objective. Only elements that were stepped to count: the first of a sequence and those with
    ``is_init`` hold an initial belief. The sensor counts where it observed.

    Args:
        filter: the filter to train, e.g. :class:`~torch_denkf.filters.DPF`. Members without weights count alike.
        score: ``"mixture"``, in nats, or ``"crps"``, the weighted CRPS (not fair: there is no fair one with weights)
            in each dimension, averaged.
        component_std: :math:`\sigma`, a number or one for each of ``dims``, else of the labels' dimensions, in units of
            ``state_scale``.
        state: weight of ``loss_state``.
        transition: weight of ``loss_transition``.
        mean: weight of ``loss_mean``.
        sensor: weight of ``loss_sensor``.
        nll: weight of ``loss_nll``.
        **options: ``dims``, scales, angles, ``detach_every`` and ``reduction``, see :class:`SequenceOptions`. With a
            ``state_scale`` the mixture is a density of the state in its own units all the same.

    Raises:
        ValueError: on an unknown score, a width or scale that is not positive or of another length than ``dims``,
            labels of another shape, or slices that are not marked.
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
        """The entries that the loss reads beside those of :class:`FilterLoss`.

        Attributes:
            belief: prefix of ``ensemble`` and ``log_weight`` of the belief.
            forecast: prefix of ``ensemble`` and ``log_weight`` of the forecast.
            log_likelihood: of the reading.
        """

        belief: NestedKey = "belief"
        forecast: NestedKey = "forecast"

    default_keys = _AcceptedKeys
    SUPERVISED = ("state", "transition", "mean", "sensor")
    SCORES = ("mixture", "crps")
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
        **options: Unpack[SequenceOptions],
    ):
        weights = dict(zip(self.TERMS, (state, transition, mean, sensor, nll), strict=True))
        super().__init__(filter, weights, score=score, **options)
        self.register_scale("component_std", component_std)
        if not ((self.component_std > 0) & self.component_std.isfinite()).all():
            raise ValueError(f"component_std is the width of each component, positive and finite; got {component_std}.")
        if self.dims is not None and self.component_std.numel() not in (1, len(self.dims)):
            raise ValueError(f"component_std has one entry for each of dims={self.dims}; got {component_std}.")

    # ------------------------------------------------------------------------------- terms: value and mask [*B, T]

    def _state(self, tensordict, out):
        return self._score(tensordict, out, self.tensor_keys.belief)

    def _transition(self, tensordict, out):
        return self._score(tensordict, out, self.tensor_keys.forecast)

    def _mean(self, tensordict, out):
        errors, log_weights, labels = self._errors(tensordict, out, self.tensor_keys.belief)
        # The mean of errors, because the mean of angles on both sides of pi is none.
        return mean_of(weighted_mean(errors, log_weights).square(), labels.mask), labels.rows

    # ------------------------------------------------------------------------------------------------------ helpers

    def _errors(
        self, tensordict: TensorDictBase, out: TensorDictBase, prefix: NestedKey
    ) -> tuple[torch.Tensor, torch.Tensor, Labels]:
        """Errors of the particles ``[*B, T, E, S]``, their log-weights ``[*B, T, E]`` and the labels."""
        particles = self._entry(out, (prefix, "ensemble"), BELIEFS)
        log_weights = out.get((prefix, "log_weight"), None)
        if log_weights is None:
            log_weights = torch.full_like(particles[..., 0], -math.log(particles.shape[-2]))
        labels = self._state_labels(tensordict, particles.shape[-1])
        return labels.errors(particles, self.angles), log_weights, labels

    def _score(self, tensordict, out, prefix: NestedKey):
        errors, log_weights, labels = self._errors(tensordict, out, prefix)
        std = labels.in_all_components("component_std", self.component_std)
        return score_mixture(errors, labels.mask, log_weights, self.score, std, labels.scale), labels.rows
