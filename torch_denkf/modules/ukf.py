"""The unscented Kalman filter's two steps: sigma points are ensembles, and go through the same modules."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase

from torch_denkf.functional.unscented import (
    UnscentedWeights,
    sigma_points,
    unscented_moments,
    unscented_update,
    unscented_weights,
)
from torch_denkf.modules._gaussian import GaussianAnalysis, GaussianTransition

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
    r"""Forecast of mean and covariance from sigma points that go through a transition as an ensemble of 2 S + 1.

    The transition's stochastic networks run their deterministic forward. One that mixes its members, such as
    ``UnicycleTransition(drift=False)`` with a network that depends on the velocity, mixes the sigma points.

    Args:
        transition: forecasts ensembles ``[*B, E, S]``.
        process_noise: writes Q, variances ``[*B, S]`` or a covariance ``[*B, S, S]``, see
            :mod:`torch_denkf.modules.process_noise`; it may read the belief's mean and the forecast's.
        alpha: see :func:`torch_denkf.functional.unscented_weights`.
        beta: likewise.
        kappa: likewise.
        belief_key: prefix of ``mean`` ``[*B, S]`` and ``cov`` ``[*B, S, S]`` of the last analysis; ``cov`` may be
            singular.
        forecast_key: prefix of ``mean`` and ``cov`` of the forecast.
        ensemble_key: what the transition reads.
        forecast_ensemble_key: what it writes.

    Raises:
        ValueError: if the transition holds random layers outside a :class:`~torch_denkf.modules.StochasticMLP`, or
            draws its own noise.

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
        belief_key: str = "belief",
        forecast_key: str = "forecast",
        ensemble_key: NestedKey = ("belief", "ensemble"),
        forecast_ensemble_key: NestedKey = ("forecast", "ensemble"),
    ):
        super().__init__(
            transition,
            process_noise,
            belief_key=belief_key,
            forecast_key=forecast_key,
            ensemble_key=ensemble_key,
            forecast_ensemble_key=forecast_ensemble_key,
        )
        self.alpha, self.beta, self.kappa = alpha, beta, kappa

    def _forecast(self, entries, mean, cov, call):
        points, weights = self._points(mean, cov)
        return unscented_moments(self._move(entries, points, call), weights)


class UKFAnalysis(_SigmaPoints, GaussianAnalysis):
    """The update of mean and covariance by fresh sigma points of the forecast, through an observation model.

    Args:
        observation: observes ensembles ``[*B, E, S]``; whatever else it reads or writes, such as a mask, it finds and
            leaves in a copy of the tensordict.
        alpha: see :func:`torch_denkf.functional.unscented_weights`.
        beta: likewise.
        kappa: likewise.
        inflation: factor on the belief's standard deviations, where anything is observed; 1 for none. What is never
            observed, such as a vehicle's position, grows by it without bound: scale Q and R there.
        angles: components of the observation that are angles in radians.
        observation_key: learned observations ``[*B, E, O]``, whose mean is used, or readings ``[*B, O]``.
        noise_variance_key: R, variances ``[*B, O]`` or a covariance ``[*B, O, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``, read after ``observation`` has run.
        **keys: see :class:`EKFAnalysis`.

    Raises:
        ValueError: if the model holds random layers outside a :class:`~torch_denkf.modules.StochasticMLP`.
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import Select
        >>> td = TensorDict({
        ...     "forecast": {"mean": torch.zeros(2), "cov": torch.eye(2)},
        ...     "sensor": {"ensemble": torch.ones(1), "noise": torch.ones(1)},
        ... })
        >>> UKFAnalysis(Select([1]))(td)["belief", "mean"].round(decimals=4)
        tensor([0.0000, 0.5000])
    """

    def __init__(
        self,
        observation: TensorDictModuleBase,
        *,
        alpha: float = 1.0,
        beta: float = 0.0,
        kappa: float = 0.5,
        inflation: float = 1.0,
        angles: Sequence[int] = (),
        observation_key: NestedKey = ("sensor", "ensemble"),
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        **keys: NestedKey,
    ):
        super().__init__(
            observation,
            inflation=inflation,
            angles=angles,
            observation_key=observation_key,
            noise_variance_key=noise_variance_key,
            observed_key=observed_key,
            **keys,
        )
        self.alpha, self.beta, self.kappa = alpha, beta, kappa

    def _update(self, entries, mean, cov, observation, noise, call):
        points, weights = self._points(mean, cov)
        predicted, observed = self._observe(entries, points, call)
        update = unscented_update(points, predicted, observation, noise, weights, observed=observed, angles=self.angles)
        return update, observed
