"""The exact linear-Gaussian filter in modules: initial beliefs, transition, analysis of mean and covariance."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.modules._base import SubModel
from torch_denkf.modules._gaussian import as_covariance, further_keys, write_update

__all__ = ["GaussianAround", "KalmanAnalysis", "LinearTransition", "MomentPrior"]


def _matrix(value) -> torch.Tensor:
    return torch.as_tensor(value, dtype=torch.get_default_dtype())


def _keep(module: nn.Module, name: str, value, trainable: bool) -> None:
    """Registers a matrix as a parameter or as a buffer; ``None`` as a buffer."""
    value = None if value is None else _matrix(value)
    if trainable and value is not None:
        module.register_parameter(name, nn.Parameter(value.clone()))
    else:
        module.register_buffer(name, value)


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


class GaussianAround(SubModel):
    """A Gaussian belief around a state that is known at reset, e.g. the ground truth of a data set.

    Like :class:`~torch_denkf.modules.AroundState`, for filters with a mean and a covariance.

    Args:
        std: standard deviations ``[S]``, in the state's units; zero where the state is known exactly.
        state_key: the known state ``[*B, S]``.
        belief_key: prefix of ``mean`` ``[*B, S]``, ``cov`` ``[*B, S, S]`` (diagonal) and ``var`` ``[*B, S]``.

    Raises:
        ValueError: if a standard deviation is negative.
        KeyError: if ``state_key`` is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> around = GaussianAround([0.0, 2.0])
        >>> around(TensorDict({"state": torch.tensor([5.0, 6.0])}))["belief", "cov"]
        tensor([[0., 0.],
                [0., 4.]])
    """

    def __init__(
        self, std: Sequence[float] | torch.Tensor, *, state_key: NestedKey = "state", belief_key: str = "belief"
    ):
        super().__init__(nn.Identity(), [state_key], [(belief_key, name) for name in ("mean", "cov", "var")])
        std = _matrix(std)
        if std.ndim != 1 or not (std >= 0).all():
            raise ValueError(f"std holds one non-negative standard deviation a state dimension; got {std}.")
        self.register_buffer("std", std)
        self.state_dim = std.numel()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the belief."""
        mean = self.read(tensordict, self.in_keys[0]).to(self.std.dtype)
        variance = self.std.square().expand_as(mean)
        for key, value in zip(self.out_keys, (mean, variance.diag_embed(), variance), strict=True):
            tensordict.set(key, value)
        return tensordict


class LinearTransition(SubModel):
    r"""Forecast of mean and covariance, :math:`F m + B a` and :math:`F P F^T + Q`.

    Args:
        matrix: F, ``[S, S]``.
        noise: Q, ``[S, S]``, or a module that writes it, see :mod:`torch_denkf.modules.process_noise`.
        control: B, ``[S, A]``; ``None`` for none.
        trainable: whether F and B are parameters.
        action_key: entry ``[*B, A]``, with ``control``.
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
        noise: torch.Tensor | TensorDictModuleBase,
        *,
        control: torch.Tensor | None = None,
        trainable: bool = False,
        action_key: NestedKey = "action",
        belief_key: str = "belief",
        forecast_key: str = "forecast",
    ):
        in_keys, out_keys = ([(key, name) for name in ("mean", "cov")] for key in (belief_key, forecast_key))
        is_module = isinstance(noise, nn.Module)
        in_keys += [] if control is None else [action_key]
        in_keys += further_keys([noise], [*in_keys, *out_keys]) if is_module else []
        super().__init__(nn.Identity(), in_keys, out_keys)
        self.action_key = action_key
        _keep(self, "matrix", matrix, trainable)
        _keep(self, "control", control, trainable)
        if is_module:
            self.noise = noise
        else:
            self.register_buffer("noise", _matrix(noise))

    runs_on_rows = True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the forecast."""
        mean, cov = (self.read(tensordict, key) for key in self.in_keys[:2])
        noise = self.noise
        if isinstance(noise, nn.Module):
            # Added below, because it may read the forecast's mean.
            forecast, forecast_cov = kalman_predict(mean, cov, self.matrix, torch.zeros_like(cov))
        else:
            forecast, forecast_cov = kalman_predict(mean, cov, self.matrix, noise)
        if self.control is not None:
            forecast = forecast + self.read(tensordict, self.action_key).to(mean.dtype) @ self.control.mT
        if isinstance(noise, nn.Module):
            work = noise(tensordict.copy().set(self.out_keys[0], forecast))
            forecast_cov = forecast_cov + as_covariance(self.read(work, noise.out_keys[0]), mean)
        tensordict.set(self.out_keys[0], forecast)
        return tensordict.set(self.out_keys[1], forecast_cov)


class KalmanAnalysis(SubModel):
    """The Kalman update of mean and covariance (Joseph form).

    Args:
        matrix: H, ``[O, S]``.
        noise: R, variances ``[O]`` or a covariance ``[O, O]``; ``None`` to read it from ``noise_variance_key``.
        trainable: whether H is a parameter.
        inflation: factor on the belief's standard deviations, where anything is observed; 1 for none. What is never
            observed, such as a vehicle's position, grows by it without bound: scale Q and R there.
        observation_key: readings ``[*B, O]``, or learned observations ``[*B, E, O]``, whose mean is used.
        noise_variance_key: R, variances ``[*B, O]`` or a covariance ``[*B, O, O]``, where ``noise`` is ``None``.
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
        noise: torch.Tensor | None,
        *,
        trainable: bool = False,
        inflation: float = 1.0,
        observation_key: NestedKey = "observation",
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        forecast_key: str = "forecast",
        belief_key: str = "belief",
        info_key: str = "info",
    ):
        super().__init__(
            nn.Identity(),
            [(forecast_key, "mean"), (forecast_key, "cov"), observation_key]
            + ([noise_variance_key] if noise is None else []),
            [(belief_key, name) for name in ("mean", "cov", "var")]
            + [(info_key, name) for name in ("innovation", "nis", "log_likelihood")],
            optional_keys=[observed_key],
        )
        self.inflation = inflation
        _keep(self, "matrix", matrix, trainable)
        self.register_buffer("noise", None if noise is None else _matrix(noise))

    def observe(self, state: torch.Tensor) -> torch.Tensor:
        """Returns ``H x`` of states ``[*, S]``."""
        return state @ self.matrix.mT

    runs_on_rows = True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the belief and the diagnostics."""
        mean, cov, observation, *noise = (self.read(tensordict, key) for key in self.in_keys)
        noise = noise[0] if noise else self.noise.expand(*tensordict.batch_size, *self.noise.shape)
        if observation.ndim > mean.ndim:
            observation = observation.mean(-2)
        observed = tensordict.get(self.optional_keys[0], None)
        update = kalman_update(mean, cov, observation, self.matrix, noise, observed=observed)
        write_update(self, tensordict, update, observed, self.inflation)
        return tensordict
