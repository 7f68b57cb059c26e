"""The training objective of filters with a mean and a covariance, on sequences."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Unpack

from tensordict import NestedKey

from torch_denkf.filters import Filter
from torch_denkf.objectives._base import BELIEFS
from torch_denkf.objectives._options import SequenceOptions
from torch_denkf.objectives._scores import GAUSSIAN_SCORES, score_gaussian
from torch_denkf.objectives._sequence import SequenceLoss

__all__ = ["GaussianLoss"]


class GaussianLoss(SequenceLoss):
    r"""Scores a filter with a mean and a covariance on sequences ``[*B, T]`` against the true states.

    The counterpart of :class:`~torch_denkf.objectives.DEnKFLoss`, whose fair CRPS estimates from members what is a
    closed form here; filters trained with the two have the same objective.

    ========================  =====================================================================================
    ``loss_state``            score of the belief against the true state
    ``loss_transition``       score of the forecast against the true state
    ``loss_sensor``           fair CRPS of the sensor's samples against the true observation, which is the absolute
                              error of one sample or one reading; squared error of their mean with ``score="mse"``
    ``loss_nll``              negative log-likelihood of the innovation, nats; needs no true state
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied. Only
    elements that were stepped to count for state, transition and nll. The sensor counts where it observed.

    Args:
        filter: the filter to train, e.g. :class:`~torch_denkf.filters.EKF`.
        score: of the Gaussian: ``"crps"`` in each dimension, averaged; ``"nll"``, the negative log-density of all
            dimensions together, in nats; ``"mse"`` of the mean.
        state: weight of ``loss_state``.
        transition: weight of ``loss_transition``.
        sensor: weight of ``loss_sensor``; by default 1 where a module of the filter writes the sensor's samples (or
            ``set_keys(sensor=...)`` names them), else the term is left out.
        nll: weight of ``loss_nll``.
        **options: ``dims``, scales, angles, ``detach_every`` and ``reduction``, see :class:`SequenceOptions`. It also
            says what gaps in the labels are.

    Raises:
        ValueError: on an unknown score, a scale that is not positive or of another length than ``dims``, labels of
            another shape, or slices that are not marked.
        KeyError: if an entry that a term needs is missing.

    Reference:
        Gneiting, Raftery, Westveld, Goldman, "Calibrated probabilistic forecasting using ensemble model output
        statistics and minimum CRPS estimation", Mon. Weather Rev. 133, 2005, for the CRPS of a Gaussian.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import KalmanFilter
        >>> one = torch.eye(1)
        >>> loss = GaussianLoss(KalmanFilter(one, one, one, one, mean=torch.zeros(1), cov=one), sensor=0.0)
        >>> loss(TensorDict({"observation": torch.zeros(8, 1), "state": torch.zeros(8, 1)}, [8]))["loss_state"]
        tensor(0.1849)
    """

    @dataclass
    class _AcceptedKeys(SequenceLoss._AcceptedKeys):
        """The entries that the loss reads beside those of :class:`FilterLoss`.

        Attributes:
            belief: prefix of ``mean`` and ``cov`` of the belief.
            forecast: prefix of ``mean`` and ``cov`` of the forecast.
        """

        belief: NestedKey = "belief"
        forecast: NestedKey = "forecast"

    default_keys = _AcceptedKeys
    SCORES = GAUSSIAN_SCORES
    TERMS = ("state", "transition", "sensor", "nll")

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "nll", "mse"] = "crps",
        state: float = 1.0,
        transition: float = 1.0,
        sensor: float | None = None,
        nll: float = 0.0,
        **options: Unpack[SequenceOptions],
    ):
        weights = dict(zip(self.TERMS, (state, transition, sensor, nll), strict=True))
        super().__init__(filter, weights, score=score, **options)

    # ------------------------------------------------------------------------------- terms: value and mask [*B, T]

    def _state(self, tensordict, out):
        return self._score(tensordict, out, self.tensor_keys.belief)

    def _transition(self, tensordict, out):
        return self._score(tensordict, out, self.tensor_keys.forecast)

    # ------------------------------------------------------------------------------------------------------ helpers

    def _score(self, tensordict, out, prefix: NestedKey):
        mean, cov = (self._entry(out, (prefix, name), BELIEFS) for name in ("mean", "cov"))
        labels = self._state_labels(tensordict, mean.shape[-1])
        return score_gaussian(labels.errors(mean, self.angles), labels.mask, cov, self.score, labels.scale), labels.rows
