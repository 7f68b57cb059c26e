"""The unscented Kalman filter's two steps, which pass sigma points as ensembles through the same modules."""

from __future__ import annotations

from typing import Unpack

import torch
from tensordict.nn import TensorDictModuleBase

from torch_denkf._checks import check_number
from torch_denkf.functional.manifolds import is_flat
from torch_denkf.functional.unscented import (
    UnscentedWeights,
    sigma_points,
    unscented_anomalies,
    unscented_moments,
    unscented_update,
    unscented_weights,
)
from torch_denkf.modules.gaussian import (
    GaussianAnalysis,
    GaussianAnalysisOptions,
    GaussianTransition,
    GaussianTransitionKeys,
)

__all__ = ["UKFAnalysis", "UKFTransition"]


class _SigmaPoints:
    """Sigma points and their weights, for a module with alpha, beta and kappa."""

    alpha: float
    beta: float
    kappa: float

    def _points(self, mean: torch.Tensor, cov: torch.Tensor) -> tuple[torch.Tensor, UnscentedWeights]:
        weights = unscented_weights(
            mean.shape[-1], alpha=self.alpha, beta=self.beta, kappa=self.kappa, dtype=mean.dtype, device=mean.device
        )
        return sigma_points(mean, cov, alpha=self.alpha, kappa=self.kappa), weights


class UKFTransition(_SigmaPoints, GaussianTransition):
    r"""Forecast of mean and covariance: 2 S + 1 sigma points pass through the transition as an ensemble.

    The transition's stochastic networks run their deterministic forward. A network that couples its members, for
    example by subtracting their mean, couples the sigma points.

    Args:
        transition: forecasts ensembles ``[*B, E, S]``.
        process_noise: writes Q, variances ``[*B, S]`` or a covariance ``[*B, S, S]``, see
            :mod:`torch_denkf.modules.process_noise`.
        alpha: spread of the sigma points.
        beta: extra weight of the central point in the covariance.
        kappa: second scaling parameter of the spread.
        **keys: see :class:`GaussianTransitionKeys`. The covariance of the last analysis may be singular.

    Raises:
        ValueError: if the transition has random layers outside a :class:`~torch_denkf.modules.StochasticMLP`.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise, LearnedTransition
        >>> noise = ConstantNoise([1.0], in_key=("belief", "mean"), out_key=("forecast", "noise"))
        >>> square = UKFTransition(LearnedTransition(torch.square, residual=False), noise)
        >>> td = square(TensorDict({"belief": {"mean": torch.zeros(1), "cov": torch.eye(1)}}))
        >>> td["forecast", "mean"].round(decimals=4)  # E x^2
        tensor([1.])
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        process_noise: TensorDictModuleBase,
        *,
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float = 0.5,
        **keys: Unpack[GaussianTransitionKeys],
    ):
        super().__init__(transition, process_noise, **keys)
        for name, value in (("alpha", alpha), ("beta", beta), ("kappa", kappa)):
            check_number(name, value, above=0 if name == "alpha" else None)
        self.alpha, self.beta, self.kappa = alpha, beta, kappa

    def _forecast(self, entries, mean, cov, call, wanted):
        if self.space is None:
            points, weights = self._points(mean, cov)
            moved = self._move(entries, points, call)
            link = unscented_anomalies(points, moved, weights) if wanted else None
            return *unscented_moments(moved, weights), link
        points, weights = self._points(torch.zeros_like(cov[..., 0]), cov)
        moved = self._move(entries, self.space.plus(mean.unsqueeze(-2), points), call)
        center = self.space.mean(moved, weights.mean)
        tangents = self.space.minus(moved, center.unsqueeze(-2))
        link = unscented_anomalies(points, tangents, weights) if wanted else None
        return center, unscented_moments(tangents, weights)[1], link


class UKFAnalysis(_SigmaPoints, GaussianAnalysis):
    """The update of mean and covariance: new sigma points of the forecast pass through an observation model.

    Args:
        observation: observes ensembles ``[*B, E, S]``.
        alpha: spread of the sigma points.
        beta: extra weight of the central point in the covariance.
        kappa: second scaling parameter of the spread.
        **options: see :class:`GaussianAnalysisOptions`.

    Raises:
        ValueError: if the model has random layers outside a :class:`~torch_denkf.modules.StochasticMLP`.
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import LearnedObservation
        >>> forecast = {"mean": torch.zeros(1), "cov": torch.eye(1)}
        >>> reading = {"ensemble": torch.tensor([4.0]), "noise": torch.ones(1)}
        >>> td = TensorDict({"forecast": forecast, "sensor": reading})
        >>> UKFAnalysis(LearnedObservation(torch.square))(td)["info", "innovation"].round(decimals=4)  # 4 - E x^2
        tensor([3.])
    """

    def __init__(
        self,
        observation: TensorDictModuleBase,
        *,
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float = 0.5,
        **options: Unpack[GaussianAnalysisOptions],
    ):
        super().__init__(observation, **options)
        for name, value in (("alpha", alpha), ("beta", beta), ("kappa", kappa)):
            check_number(name, value, above=0 if name == "alpha" else None)
        self.alpha, self.beta, self.kappa = alpha, beta, kappa

    def _update(self, entries, mean, cov, observation, noise, call):
        on = self.reading_space
        if self.space is None and is_flat(on):
            points, weights = self._points(mean, cov)
            predicted, observed = self._observe(entries, points, call)
            return unscented_update(
                points, predicted, observation, noise, weights, observed=observed, space=on
            ), observed
        points, weights = self._points(torch.zeros_like(cov[..., 0]), cov)
        around = mean.unsqueeze(-2)
        around = around + points if self.space is None else self.space.plus(around, points)
        predicted, observed = self._observe(entries, around, call)
        if on is not None and on.flat is None:
            expected = on.mean(predicted, weights.mean)
            observation = self._innovation(observation, expected, observed)
            mask = None if observed is None else observed.unsqueeze(-2)
            predicted, on = on.innovation(predicted, expected.unsqueeze(-2), mask), None
        update = unscented_update(points, predicted, observation, noise, weights, observed=observed, space=on)
        return self._moved(mean, update), observed
