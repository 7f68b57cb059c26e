"""Training objectives of whole filters on sequences: for ensembles, for moments and for weighted particles."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Unpack

from tensordict import NestedKey
from torch import Tensor

from torch_denkf._checks import check_values
from torch_denkf.filters import Filter
from torch_denkf.modules.tensors import as_floating
from torch_denkf.objectives import _terms
from torch_denkf.objectives.filter_loss import FilterLoss, SequenceKeys, SequenceOptions, Term
from torch_denkf.smoothers.base import Smoother

__all__ = ["DEnKFLoss", "GaussianLoss", "MixtureLoss"]


class DEnKFLoss(FilterLoss):
    r"""Scores a filter on sequences ``[*B, T]`` against the true states.

    The default score of an ensemble is the fair CRPS, a proper score: it trains the mean *and* the spread. The
    paper's loss, the squared error of the mean, does not train the spread, and a filter with a wrong spread can
    be worse than its own sensor. ``DEnKFLoss.paper(filter)`` returns the paper's loss.

    ========================  =====================================================================================
    ``loss_state``            score of the belief, :math:`X_{t|t}` against :math:`x_t`
    ``loss_transition``       score of the forecast, :math:`X_{t|t-1}` against :math:`x_t` (the paper's
                              :math:`L_{f_\theta}`)
    ``loss_sensor``           score of the sensor's samples against the true observation (:math:`L_{s_\xi}`)
    ``loss_observation``      squared error of :math:`h_\psi(x_t)` against the true observation
    ``loss_nll``              negative log-likelihood of the innovation, nats; needs no true state
    ``loss_visible``          binary cross entropy of the sensor's visibility, for a filter with a
                              :class:`~torch_denkf.imperfect.Visibility`
    ``loss_smoothed``         score of the smoothed belief of each time, given later readings, against :math:`x_t`
    ``loss_kl``               KL divergence of flipout weights from their prior, nats
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied, so
    that their sum is the objective. Only elements that are results of a step are scored for state, transition, smoothed
    and nll: the first of a sequence and those with ``is_init`` have an initial belief. The sensor is scored in
    observed elements.

    Args:
        filter: the filter to train; its parameters are the loss's.
        score: ``"crps"`` (fair), ``"energy"`` (fair energy score, multivariate) or ``"mse"`` (of the mean). For one
            member the first two are its absolute error, and the length of its error: the scores of a point.
        state: weight of ``loss_state``.
        transition: weight of ``loss_transition``.
        sensor: weight of ``loss_sensor``; by default 1 if a module of the filter writes the sensor's samples (or
            ``set_keys(sensor=...)`` gives their key), else 0.
        observation: weight of ``loss_observation``.
        nll: weight of ``loss_nll``.
        visible: weight of ``loss_visible``; its labels are ``"visible"``, and may have gaps.
        kl: weight of ``loss_kl``.
        smoothed: weight of ``loss_smoothed``.
        smoother: returns the smoother, e.g. ``partial(EnRTS, lag=10)`` or
            :class:`~torch_denkf.smoothers.EnRTS`; it is called with the filter.
        terms: further terms of your own, see :class:`Term`.
        **options: ``dims``, scales, ``space``, ``reading_space``, ``detach_every`` and ``reduction``, see
            :class:`~torch_denkf.objectives.filter_loss.SequenceOptions`, also for gaps in the labels.

    Raises:
        ValueError: on an unknown score, a scale that is not positive, labels of another shape, or slices that are not
            marked.
        TypeError: for particles with weights, which :class:`MixtureLoss` scores; or if ``smoother`` makes no smoother.
        KeyError: if an entry that a term needs is missing.

    Reference:
        Fair CRPS: Ferro, "Fair scores for ensemble forecasts", Q. J. R. Meteorol. Soc. 140, 2014.

    Example:
        >>> import torch
        >>> from torch_denkf.filters import DEnKF
        >>> loss = DEnKFLoss(DEnKF.paper(5, 2, ensemble_size=4), sensor=0.0)
        >>> from tensordict import TensorDict
        >>> batch = TensorDict({"pixels": torch.rand(2, 3, 6, 50, 150), "state": torch.randn(2, 3, 5)}, [2, 3])
        >>> sorted(loss(batch).keys())
        ['loss_state', 'loss_transition']
    """

    @dataclass
    class _AcceptedKeys(SequenceKeys):
        """The input keys of the loss, in addition to those of all losses.

        Attributes:
            belief: ensemble of the belief.
            forecast: ensemble of the forecast.
            smoothed: ensemble of the smoothed belief.
        """

        belief: NestedKey = ("belief", "ensemble")
        forecast: NestedKey = ("forecast", "ensemble")
        smoothed: NestedKey = ("smoothed", "ensemble")

    default_keys = _AcceptedKeys
    SCORES = _terms.MEMBER_SCORES

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
        visible: float = 0.0,
        kl: float = 0.0,
        smoothed: float = 0.0,
        smoother: Callable[[Filter], Smoother] | None = None,
        terms: Sequence[Term] = (),
        **options: Unpack[SequenceOptions],
    ):
        if smoothed and smoother is None:
            raise ValueError("loss_smoothed needs a smoother: smoother=EnRTS, or partial(EnKS, lag=5), for example.")
        own: list[Term] = [_terms.Members("state", "belief", state)]
        own += [_terms.Members("transition", "forecast", transition)]
        own += [_terms.Sensor(sensor), _terms.Observation(observation), _terms.Likelihood(nll), _terms.Divergence(kl)]
        own += [_terms.Visible(visible), _terms.Members("smoothed", "smoothed", smoothed)]
        super().__init__(filter, [*own, *terms], score=score, **options)
        made = smoother if smoother is None or isinstance(smoother, Smoother) else smoother(filter)
        if smoother is not None and (made is smoother or not isinstance(made, Smoother)):
            raise TypeError(
                "smoother is called with the filter and returns a Smoother, like EnRTS or partial(EnKS, lag=5); got "
                f"{smoother!r}"
            )
        # In a tuple, so that it is no sub-module: its parameters are the filter's, which the loss has already.
        self._smoother = (made,)

    @classmethod
    def paper(cls, filter: Filter, **kwargs) -> DEnKFLoss:
        """Returns the paper's loss: squared errors of the means of belief, forecast and sensor, equally weighted."""
        return cls(filter, **{"score": "mse", **kwargs})

    @classmethod
    def ad_enkf(cls, filter: Filter, *, detach_every: int | None = None, **kwargs) -> DEnKFLoss:
        r"""Trains without true states: by the likelihood of the innovations only, as in AD-EnKF.

        .. math:: -\log p(y_{1:T}) \approx -\sum_t \log N(y_t; H \bar x_{t|t-1}, H C_{t|t-1} H^T + R)

        with the mean and the sample covariance of the forecast ensemble, here as the mean over time steps and
        sequences. Everything with a gradient is learned: dynamics, process noise, observation noise. A learned sensor
        needs further terms to keep its meaning: a constant reading is the most likely one.

        Args:
            filter: the filter to train; with the analysis scheme ``"perturbed"`` it is the paper's.
            detach_every: length of the sub-sequences between which the gradient is cut (the paper's AD-EnKF-T), as is
                needed for chaotic dynamics.
            **kwargs: passed on to the constructor, e.g. the weights of further terms.

        Reference:
            Chen, Sanz-Alonso, Willett, "Autodifferentiable ensemble Kalman filters", SIAM J. Math. Data Sci. 4, 2022,
            arXiv:2107.07687.

        Example:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from torch_denkf.filters import DEnKF
            >>> loss = DEnKFLoss.ad_enkf(DEnKF.paper(5, 2, ensemble_size=4), detach_every=10)
            >>> sorted(loss(TensorDict({"pixels": torch.rand(2, 3, 6, 50, 150)}, [2, 3])).keys())
            ['loss_nll']
        """
        weights = {"state": 0.0, "transition": 0.0, "sensor": 0.0, "nll": 1.0}
        return cls(filter, detach_every=detach_every, **{**weights, **kwargs})

    def _filters(self):
        return self._smoother[0] if "smoothed" in self.weights else self.filter


class GaussianLoss(FilterLoss):
    r"""Scores a filter with a mean and a covariance on sequences ``[*B, T]`` against the true states.

    It is the counterpart of :class:`~torch_denkf.objectives.DEnKFLoss`, whose fair CRPS estimates from members the
    closed form here; filters trained with the two have the same objective.

    ========================  =====================================================================================
    ``loss_state``            score of the belief against the true state
    ``loss_transition``       score of the forecast against the true state
    ``loss_sensor``           fair CRPS of the sensor's samples against the true observation, which is the absolute
                              error for one sample or one reading; squared error of their mean with ``score="mse"``
    ``loss_nll``              negative log-likelihood of the innovation, nats; needs no true state
    ``loss_visible``          binary cross entropy of the sensor's visibility, for a filter with a
                              :class:`~torch_denkf.imperfect.Visibility`
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied. Only
    elements that are results of a step are scored for state, transition and nll; the sensor in observed ones.

    Args:
        filter: the filter to train, e.g. :class:`~torch_denkf.filters.EKF`.
        score: score of the Gaussian: ``"crps"`` in each dimension, averaged; ``"nll"``, the negative log-density of all
            dimensions together, in nats; ``"mse"`` of the mean.
        state: weight of ``loss_state``.
        transition: weight of ``loss_transition``.
        sensor: weight of ``loss_sensor``; by default 1 if a module of the filter writes the sensor's samples (or
            ``set_keys(sensor=...)`` gives their key), else 0.
        nll: weight of ``loss_nll``.
        visible: weight of ``loss_visible``; its labels are ``"visible"``, and may have gaps.
        terms: further terms of your own, see :class:`Term`.
        **options: ``dims``, scales, ``space``, ``reading_space``, ``detach_every`` and ``reduction``, see
            :class:`~torch_denkf.objectives.filter_loss.SequenceOptions`, also for gaps in the labels.

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
        >>> plain = KalmanFilter(one, one, process_noise=[1.0], noise=[1.0], mean=torch.zeros(1), cov=one)
        >>> loss = GaussianLoss(plain, sensor=0.0)
        >>> loss(TensorDict({"observation": torch.zeros(8, 1), "state": torch.zeros(8, 1)}, [8]))["loss_state"]
        tensor(0.1849)
    """

    SCORES = _terms.GAUSSIAN_SCORES

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["crps", "nll", "mse"] = "crps",
        state: float = 1.0,
        transition: float = 1.0,
        sensor: float | None = None,
        nll: float = 0.0,
        visible: float = 0.0,
        terms: Sequence[Term] = (),
        **options: Unpack[SequenceOptions],
    ):
        own: list[Term] = [_terms.Moments("state", "belief", state)]
        own += [_terms.Moments("transition", "forecast", transition)]
        own += [_terms.Sensor(sensor), _terms.Likelihood(nll), _terms.Visible(visible)]
        super().__init__(filter, [*own, *terms], score=score, **options)


class MixtureLoss(FilterLoss):
    r"""Scores a filter with weighted particles on sequences ``[*B, T]`` against the true states.

    The default score is of a mixture of Gaussians around the particles: :math:`-\log \sum_i w^i N(x; x^i,
    \mathrm{diag}(\sigma^2))`; it has a gradient even if no particle is near the truth. It is the "M" of Kloss' dPF-M.
    The CRPS has no such width to choose, and makes filters comparable with filters trained with
    :class:`~torch_denkf.objectives.DEnKFLoss`.

    ========================  =====================================================================================
    ``loss_state``            score of the belief against the true state
    ``loss_transition``       score of the forecast, with its weights, against the true state
    ``loss_mean``             squared error of the belief's weighted mean
    ``loss_sensor``           fair CRPS of the sensor's samples against the true observation, which is the absolute
                              error for one sample or one reading
    ``loss_nll``              negative log-likelihood of the reading, nats; needs no true state
    ``loss_visible``          binary cross entropy of the sensor's visibility, for a filter with a
                              :class:`~torch_denkf.imperfect.Visibility`
    ========================  =====================================================================================

    Terms with weight zero are neither computed nor returned; the others are returned with their weight applied, so
    that their sum is the objective. Only elements that are results of a step are scored: the first of a sequence and
    those with ``is_init`` have an initial belief. The sensor is scored in observed elements.

    Args:
        filter: the filter to train, e.g. :class:`~torch_denkf.filters.DPF`. Members without weights have equal weight.
        score: ``"mixture"``, in nats, or ``"crps"``, the weighted CRPS (not fair: there is no fair one with weights)
            in each dimension, averaged.
        component_std: :math:`\sigma`, one number or one for each of ``dims``, else of the labels' dimensions, in units
            of ``state_scale``.
        state: weight of ``loss_state``.
        transition: weight of ``loss_transition``.
        mean: weight of ``loss_mean``.
        sensor: weight of ``loss_sensor``.
        nll: weight of ``loss_nll``.
        visible: weight of ``loss_visible``; its labels are ``"visible"``, and may have gaps.
        terms: further terms of your own, see :class:`Term`.
        **options: ``dims``, scales, ``space``, ``reading_space``, ``detach_every`` and ``reduction``, see
            :class:`~torch_denkf.objectives.filter_loss.SequenceOptions`. The mixture is a density of the state in its
            own units, also with a ``state_scale``.

    Raises:
        ValueError: on an unknown score, a width or scale that is not positive or of another length than ``dims``,
            labels of another shape, or slices that are not marked.
        KeyError: if an entry that a term needs is missing.

    Reference:
        Jonschkowski, Rastogi & Brock, "Differentiable particle filters", 2018, arXiv:1805.11122; Kloss, Martius &
        Bohg, "How to train your differentiable filter", 2021, arXiv:2012.14313.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torch_denkf.filters import ParticleFilter
        >>> from torch_denkf.modules import ConstantNoise, GaussianLikelihood, GaussianPrior, LearnedTransition, Select
        >>> pf = ParticleFilter(
        ...     LearnedTransition(torch.nn.Linear(2, 2)),
        ...     None,
        ...     Select([0]),
        ...     GaussianLikelihood(observation_key="y"),
        ...     noise=ConstantNoise([1.0], in_key="y"),
        ...     initial=GaussianPrior([0.0, 0.0], [1.0, 1.0], ensemble_size=16),
        ... )
        >>> loss = MixtureLoss(pf, mean=1.0)
        >>> sorted(loss(TensorDict({"y": torch.zeros(3, 9, 1), "state": torch.zeros(3, 9, 2)}, [3, 9])).keys())
        ['loss_mean', 'loss_state']
    """

    SCORES = ("mixture", "crps")

    def __init__(
        self,
        filter: Filter,
        *,
        score: Literal["mixture", "crps"] = "mixture",
        component_std: float | Sequence[float] | Tensor = 1.0,
        state: float = 1.0,
        transition: float = 0.0,
        mean: float = 0.0,
        sensor: float = 0.0,
        nll: float = 0.0,
        visible: float = 0.0,
        terms: Sequence[Term] = (),
        **options: Unpack[SequenceOptions],
    ):
        own = [
            _terms.Particles("state", "belief", state),
            _terms.Particles("transition", "forecast", transition),
            _terms.Mean("mean", "belief", mean),
            _terms.Sensor(sensor),
            _terms.Likelihood(nll),
            _terms.Visible(visible),
        ]
        super().__init__(filter, [*own, *terms], score=score, **options)
        self.register_buffer("component_std", as_floating(component_std, "component_std"))
        width = "component_std is the width of each component"
        check_values("component_std", self.component_std, above=0, cure=width)
        if self.component_std.numel() > 1:
            self._check_entries("component_std", self.component_std)
