"""The training objective of ensemble filters on sequences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Unpack

import torch
from tensordict import NestedKey, TensorDictBase

from torch_denkf.filters import Filter
from torch_denkf.filters._one_sequence import refuse_unmarked_slices
from torch_denkf.modules import StochasticMLP
from torch_denkf.objectives._options import SequenceOptions
from torch_denkf.objectives._scores import MEMBER_SCORES, score_members
from torch_denkf.objectives._sequence import SequenceLoss
from torch_denkf.smoothers import Smoother

__all__ = ["DEnKFLoss"]


class DEnKFLoss(SequenceLoss):
    r"""Scores a filter on sequences ``[*B, T]`` against the true states.

    The default score of an ensemble is the fair CRPS, a proper score: it teaches the mean *and* the spread. The
    paper's loss, the squared error of the mean, says nothing about the spread, and a filter with a wrong spread can
    be worse than its own sensor. ``DEnKFLoss.paper(filter)`` is the paper's.

    ========================  =====================================================================================
    ``loss_state``            score of the belief, :math:`X_{t|t}` against :math:`x_t`
    ``loss_transition``       score of the forecast, :math:`X_{t|t-1}` against :math:`x_t` (the paper's
                              :math:`L_{f_\theta}`)
    ``loss_sensor``           score of the sensor's samples against the true observation (:math:`L_{s_\xi}`)
    ``loss_observation``      squared error of :math:`h_\psi(x_t)` against the true observation
    ``loss_nll``              negative log-likelihood of the innovation, nats; needs no true state
    ``loss_smoothed``         score of the smoothed belief of each time, given what came later, against :math:`x_t`
    ``loss_kl``               KL divergence of flipout weights from their prior, nats
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied, so
    that their sum is the objective. Only elements that were stepped to count for state, transition, smoothed and nll:
    the first of a sequence and those with ``is_init`` hold an initial belief. The sensor counts where it observed.

    Args:
        filter: the filter to train; its parameters are the loss's.
        score: ``"crps"`` (fair), ``"energy"`` (fair energy score, multivariate) or ``"mse"`` (of the mean). Of one
            member the first two are its absolute error, and the length of its error: the scores of a point.
        state: weight of ``loss_state``.
        transition: weight of ``loss_transition``.
        sensor: weight of ``loss_sensor``; by default 1 where a module of the filter writes the sensor's samples (or
            ``set_keys(sensor=...)`` names them), else the term is left out.
        observation: weight of ``loss_observation``.
        nll: weight of ``loss_nll``.
        kl: weight of ``loss_kl``.
        smoothed: weight of ``loss_smoothed``.
        smoother: makes the smoothed belief, e.g. ``partial(EnRTS, lag=10)`` or
            :class:`~torch_denkf.smoothers.EnRTS`; it is called with the filter.
        **options: scales, angles, ``detach_every`` and ``reduction``, see :class:`SequenceOptions`.

    Raises:
        ValueError: on an unknown score, a scale that is not positive, or slices that are not marked.
        KeyError: if an entry that a term needs is missing.

    Reference:
        Fair CRPS: Ferro, "Fair scores for ensemble forecasts", Q. J. R. Meteorol. Soc. 140, 2014.

    Example:
        >>> from torch_denkf.filters import DEnKF
        >>> loss = DEnKFLoss(DEnKF.paper(5, 2, ensemble_size=4), sensor=0.0)
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({"pixels": torch.rand(2, 3, 6, 50, 150), "state": torch.randn(2, 3, 5)}, [2, 3])
        >>> sorted(loss(batch).keys())
        ['loss_state', 'loss_transition']
    """

    @dataclass
    class _AcceptedKeys(SequenceLoss._AcceptedKeys):
        """The entries that the loss reads beside those of :class:`FilterLoss`.

        Attributes:
            belief: ensemble of the belief.
            forecast: ensemble of the forecast.
            smoothed: ensemble of the smoothed belief.
        """

        belief: NestedKey = ("belief", "ensemble")
        forecast: NestedKey = ("forecast", "ensemble")
        smoothed: NestedKey = ("smoothed", "ensemble")

    default_keys = _AcceptedKeys
    SUPERVISED = ("state", "transition", "sensor", "observation", "smoothed")
    SCORES = MEMBER_SCORES
    TERMS = ("state", "transition", "sensor", "observation", "nll", "kl", "smoothed")

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "energy", "mse"] = "crps",
        state: float = 1.0,
        transition: float = 1.0,
        sensor: float | None = None,
        observation: float = 0.0,
        nll: float = 0.0,
        kl: float = 0.0,
        smoothed: float = 0.0,
        smoother: Callable[[Filter], Smoother] | None = None,
        **options: Unpack[SequenceOptions],
    ):
        if smoothed and smoother is None:
            raise ValueError("loss_smoothed needs to know how: smoother=EnRTS, or partial(EnKS, lag=5), for example.")
        values = (state, transition, sensor, observation, nll, kl, smoothed)
        super().__init__(filter, dict(zip(self.TERMS, values, strict=True)), score=score, **options)
        # In a tuple: its parameters are the filter's, and are the loss's already.
        self._smoother: tuple[Smoother, ...] = (smoother(filter),) if smoother is not None else ()

    @classmethod
    def paper(cls, filter: Filter, **kwargs) -> DEnKFLoss:
        """The paper's loss: squared errors of the means of belief, forecast and sensor, equally weighted."""
        return cls(filter, **{"score": "mse", **kwargs})

    @classmethod
    def ad_enkf(cls, filter: Filter, *, detach_every: int | None = None, **kwargs) -> DEnKFLoss:
        r"""Training without true states: the likelihood of the innovations alone, as in AD-EnKF.

        .. math:: -\log p(y_{1:T}) \approx -\sum_t \log N(y_t; H \bar x_{t|t-1}, H C_{t|t-1} H^T + R)

        with the mean and the sample covariance of the forecast ensemble, here as the mean over time steps and
        sequences. Whatever has a gradient is learned: dynamics, process noise, observation noise. A sensor that is
        learned as well must keep its meaning by other terms: a constant reading is the most likely one.

        Args:
            filter: the filter to train; with the analysis scheme ``"perturbed"`` it is the paper's.
            detach_every: length of the sub-sequences between which the gradient is cut (the paper's AD-EnKF-T);
                chaotic dynamics need it.
            **kwargs: passed on to the constructor, e.g. the weights of further terms.

        Reference:
            Chen, Sanz-Alonso, Willett, "Autodifferentiable ensemble Kalman filters", SIAM J. Math. Data Sci. 4, 2022,
            arXiv:2107.07687.

        Example:
            >>> from tensordict import TensorDict
            >>> from torch_denkf.filters import DEnKF
            >>> loss = DEnKFLoss.ad_enkf(DEnKF.paper(5, 2, ensemble_size=4), detach_every=10)
            >>> sorted(loss(TensorDict({"pixels": torch.rand(2, 3, 6, 50, 150)}, [2, 3])).keys())
            ['loss_nll']
        """
        weights = {"state": 0.0, "transition": 0.0, "sensor": 0.0, "nll": 1.0}
        return cls(filter, detach_every=detach_every, **{**weights, **kwargs})

    def _run(self, tensordict):
        if "smoothed" not in self.weights:
            return super()._run(tensordict)
        refuse_unmarked_slices(tensordict, self.filter.init_key)
        return self.filter.inside(self._smoother[0].sequence(tensordict.copy(), detach_every=self.detach_every))

    # ------------------------------------------------------------------------------- terms: value and mask [*B, T]

    def _state(self, tensordict, out):
        return self._score(out, self.tensor_keys.belief, self._true_state(tensordict)), None

    def _transition(self, tensordict, out):
        return self._score(out, self.tensor_keys.forecast, self._true_state(tensordict)), None

    def _smoothed(self, tensordict, out):
        return self._score(out, self.tensor_keys.smoothed, self._true_state(tensordict)), None

    def _kl(self, tensordict, out):
        return sum(
            (part.kl() for part in self.filter.modules() if isinstance(part, StochasticMLP)), torch.zeros(())
        ), None

    # ------------------------------------------------------------------------------------------------------ helpers

    def _score(self, out: TensorDictBase, key: NestedKey, target: torch.Tensor) -> torch.Tensor:
        return score_members(self._state_error(self._entry(out, key), target.unsqueeze(-2)), self.score)
