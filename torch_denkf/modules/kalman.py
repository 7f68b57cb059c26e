"""The exact linear-Gaussian filter in three modules: initial belief, transition, analysis of mean and covariance."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import nn

from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.modules._base import SubModel

__all__ = ["KalmanAnalysis", "LinearTransition", "MomentPrior"]


def _matrix(value) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.get_default_dtype())


class MomentPrior(SubModel):
    """A Gaussian belief given by its moments, the same for every episode.

    Args:
        mean: ``[S]``.
        cov: ``[S, S]``.
        belief_key: prefix of ``mean`` ``[*B, S]``, ``cov`` ``[*B, S, S]`` and ``var`` ``[*B, S]``.

    Example:
        >>> from tensordict import TensorDict
        >>> MomentPrior(torch.zeros(2), torch.eye(2))(TensorDict({}, [3]))["belief", "cov"].shape
        torch.Size([3, 2, 2])
    """

    def __init__(self, mean: torch.Tensor, cov: torch.Tensor, *, belief_key: str = "belief"):
        super().__init__(nn.Identity(), [], [(belief_key, name) for name in ("mean", "cov", "var")])
        self.register_buffer("mean", _matrix(mean))
        self.register_buffer("cov", _matrix(cov))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the belief."""
        for key, value in zip(self.out_keys, (self.mean, self.cov, self.cov.diagonal()), strict=True):
            tensordict.set(key, value.expand(*tensordict.batch_size, *value.shape))
        return tensordict


class LinearTransition(SubModel):
    r"""Forecast of mean and covariance, :math:`F m` and :math:`F P F^T + Q`.

    Args:
        matrix: F, ``[S, S]``.
        noise: Q, ``[S, S]``.
        belief_key: prefix of ``mean`` and ``cov`` of the last analysis.
        forecast_key: prefix of ``mean`` and ``cov`` of the forecast.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"belief": {"mean": torch.ones(1), "cov": torch.ones(1, 1)}})
        >>> LinearTransition(2 * torch.eye(1), torch.eye(1))(td)["forecast", "cov"]
        tensor([[5.]])
    """

    def __init__(
        self,
        matrix: torch.Tensor,
        noise: torch.Tensor,
        *,
        belief_key: str = "belief",
        forecast_key: str = "forecast",
    ):
        names = ("mean", "cov")
        super().__init__(
            nn.Identity(), [(belief_key, name) for name in names], [(forecast_key, name) for name in names]
        )
        self.register_buffer("matrix", _matrix(matrix))
        self.register_buffer("noise", _matrix(noise))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the forecast."""
        mean, cov = (self.read(tensordict, key) for key in self.in_keys)
        for key, value in zip(self.out_keys, kalman_predict(mean, cov, self.matrix, self.noise), strict=True):
            tensordict.set(key, value)
        return tensordict


class KalmanAnalysis(SubModel):
    """The Kalman update of mean and covariance (Joseph form).

    Args:
        matrix: H, ``[O, S]``.
        noise: R, variances ``[O]`` or a covariance ``[O, O]``.
        observation_key: readings ``[*B, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``.
        forecast_key: prefix of ``mean`` and ``cov`` of the forecast.
        belief_key: prefix of ``mean``, ``cov`` and ``var``.
        info_key: prefix of ``innovation`` ``[*B, O]``, ``nis`` and ``log_likelihood`` ``[*B, 1]``.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({
        ...     "forecast": {"mean": torch.zeros(1), "cov": torch.ones(1, 1)},
        ...     "observation": torch.ones(1),
        ... })
        >>> KalmanAnalysis(torch.eye(1), torch.ones(1))(td)["belief", "mean"]
        tensor([0.5000])
    """

    def __init__(
        self,
        matrix: torch.Tensor,
        noise: torch.Tensor,
        *,
        observation_key: NestedKey = "observation",
        observed_key: NestedKey = "observed",
        forecast_key: str = "forecast",
        belief_key: str = "belief",
        info_key: str = "info",
    ):
        super().__init__(
            nn.Identity(),
            [(forecast_key, "mean"), (forecast_key, "cov"), observation_key],
            [(belief_key, name) for name in ("mean", "cov", "var")]
            + [(info_key, name) for name in ("innovation", "nis", "log_likelihood")],
            optional_keys=[observed_key],
        )
        self.register_buffer("matrix", _matrix(matrix))
        self.register_buffer("noise", _matrix(noise))

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the belief and the diagnostics."""
        mean, cov, observation = (self.read(tensordict, key) for key in self.in_keys)
        noise = self.noise.expand(*tensordict.batch_size, *self.noise.shape)
        update = kalman_update(
            mean, cov, observation, self.matrix, noise, observed=tensordict.get(self.optional_keys[0], None)
        )
        variance = update.cov.diagonal(dim1=-2, dim2=-1)
        values = (update.mean, update.cov, variance, update.innovation, update.nis, update.log_likelihood)
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value)
        return tensordict
