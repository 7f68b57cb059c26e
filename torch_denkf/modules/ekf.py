"""The extended Kalman filter's two steps, through any transition and any observation model of ensembles."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import NestedKey
from tensordict.nn import TensorDictModuleBase

from torch_denkf.functional import kalman_update
from torch_denkf.functional.unscented import wrap_angles
from torch_denkf.modules._gaussian import GaussianAnalysis, GaussianTransition

__all__ = ["EKFAnalysis", "EKFTransition"]


class EKFTransition(GaussianTransition):
    r"""Forecast :math:`f(m)` and :math:`F P F^T + Q` with the Jacobian F of the transition at the mean.

    The transition runs on an ensemble of one member; its stochastic networks run their deterministic forward. F comes
    from forward-mode differentiation of whatever it does, known motion and networks alike, and can be differentiated
    itself.

    Args:
        transition: forecasts ensembles ``[*B, E, S]``, e.g. :class:`~torch_denkf.modules.UnicycleTransition`.
        process_noise: writes Q, variances ``[*B, S]`` or a covariance ``[*B, S, S]``, see
            :mod:`torch_denkf.modules.process_noise`; it may read the belief's mean and the forecast's.
        stop_jacobian_gradient: F is a constant to the gradient (as in Kloss et al. 2021).
        belief_key: prefix of ``mean`` ``[*B, S]`` and ``cov`` ``[*B, S, S]`` of the last analysis.
        forecast_key: prefix of ``mean`` and ``cov`` of the forecast.
        ensemble_key: what the transition reads.
        forecast_ensemble_key: what it writes.

    Raises:
        ValueError: if the transition holds random layers outside a :class:`~torch_denkf.modules.StochasticMLP`.
        RuntimeError: (from torch) if it draws random numbers in some other way.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import ConstantNoise, LearnedTransition
        >>> noise = ConstantNoise([1.0], in_key=("belief", "mean"), out_key=("forecast", "noise"))
        >>> square = EKFTransition(LearnedTransition(torch.nn.Tanh(), residual=False), noise)
        >>> square(TensorDict({"belief": {"mean": torch.zeros(1), "cov": torch.eye(1)}}))["forecast", "cov"]
        tensor([[2.]])
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        process_noise: TensorDictModuleBase,
        *,
        stop_jacobian_gradient: bool = False,
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
        self.stop_jacobian_gradient = stop_jacobian_gradient

    def _forecast(self, tensordict, mean, cov):
        forecast = self._move(tensordict, mean.unsqueeze(-2)).squeeze(-2)
        jacobian = _jacobian(lambda states: self._move(tensordict, states), mean)
        if self.stop_jacobian_gradient:
            jacobian = jacobian.detach()
        cov = jacobian @ cov @ jacobian.mT
        return forecast, (cov + cov.mT) / 2


class EKFAnalysis(GaussianAnalysis):
    r"""The Kalman update with the Jacobian H of the observation model at the forecast's mean (Joseph form).

    Args:
        observation: observes ensembles ``[*B, E, S]``; whatever else it reads or writes, such as a mask, it finds and
            leaves in a copy of the tensordict.
        inflation: factor on the belief's standard deviations, where anything is observed; 1 for none.
        angles: components of the observation that are angles in radians; their innovation is wrapped to [-pi, pi).
        observation_key: learned observations ``[*B, E, O]``, whose mean is used, or readings ``[*B, O]``.
        noise_variance_key: R, variances ``[*B, O]`` or a covariance ``[*B, O, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``, read after ``observation`` has run.
        forecast_key: prefix of ``mean`` and ``cov`` of the forecast.
        belief_key: prefix of ``mean`` ``[*B, S]``, ``cov`` ``[*B, S, S]`` and ``var`` ``[*B, S]``.
        info_key: prefix of ``innovation`` ``[*B, O]``, ``nis`` and ``log_likelihood`` ``[*B, 1]``.
        ensemble_key: what the observation model reads.
        predicted_key: what it writes.

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
        >>> EKFAnalysis(Select([1]))(td)["belief", "mean"]
        tensor([0.0000, 0.5000])
    """

    def _update(self, tensordict, mean, cov, observation, noise):
        predicted, observed = self._observe(tensordict, mean.unsqueeze(-2))
        jacobian = _jacobian(lambda states: self._observe(tensordict, states)[0], mean)
        innovation = wrap_angles(observation - predicted.squeeze(-2), self.angles)
        # In deviations from the mean: H m would cost digits where the state is far from zero.
        update = kalman_update(torch.zeros_like(mean), cov, innovation, jacobian, noise, observed=observed)
        return update._replace(mean=mean + update.mean), observed


def _jacobian(function: Callable[[torch.Tensor], torch.Tensor], mean: torch.Tensor) -> torch.Tensor:
    """Jacobian ``[*B, N, S]`` at ``mean`` ``[*B, S]`` of a function ``[*B, 1, S] -> [*B, 1, N]`` of each row alone.

    One forward-mode derivative along each basis vector, in all rows at once. It is also taken where no graph is
    recorded.
    """
    state = mean.unsqueeze(-2)
    basis = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)

    def along(direction: torch.Tensor) -> torch.Tensor:
        return torch.func.jvp(function, (state,), (direction.expand_as(state),))[1].squeeze(-2)

    return torch.func.vmap(along, out_dims=-1)(basis)
