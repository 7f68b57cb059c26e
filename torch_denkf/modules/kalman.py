"""Modules of the exact linear-Gaussian filter: initial beliefs, transition, and update of mean and covariance."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_covariance, check_number, check_shape, check_square, check_values
from torch_denkf.functional import kalman_predict, kalman_update
from torch_denkf.functional.linalg import as_covariance, product_of_known
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.modules.gaussian import further_keys, updated
from torch_denkf.modules.spaces import mean_reading
from torch_denkf.modules.tensors import as_standard_deviations, register_constant, register_matrix
from torch_denkf.running import run_module
from torch_denkf.submodel import Call, Entries, Initial, Transition, Update

__all__ = ["GaussianAround", "KalmanAnalysis", "LinearTransition", "MomentPrior"]


class MomentPrior(Initial):
    """A Gaussian belief given by its moments, the same for every episode.

    Args:
        mean: ``[S]``; on a space a point.
        cov: ``[S, S]``; on a space the covariance of the tangents at ``mean``.
        space: space of the state; ``None`` for plain numbers.
        belief_prefix: prefix of ``mean`` ``[*B, S]``, ``cov`` ``[*B, S, S]`` and ``var`` ``[*B, S]``.

    Raises:
        ValueError: if the shapes do not fit, a number is not finite, or ``cov`` is no covariance.

    Example:
        >>> from tensordict import TensorDict
        >>> MomentPrior(torch.zeros(2), torch.eye(2))(TensorDict({}, [3]))["belief", "cov"].shape
        torch.Size([3, 2, 2])
    """

    def __init__(
        self, mean: torch.Tensor, cov: torch.Tensor, *, space: Space | None = None, belief_prefix: str = "belief"
    ):
        super().__init__(nn.Identity(), [], [(belief_prefix, name) for name in ("mean", "cov", "var")])
        register_constant(self, "mean", mean)
        register_constant(self, "cov", cov)
        if self.mean.ndim != 1:
            raise ValueError(f"mean must be [S], got {list(self.mean.shape)}")
        self.space, self.state_dim = check_space("space", space), self.mean.numel()
        if space is not None:
            space.check(mean=self.mean)
            self.state_dim = space.tangent_dim
        check_values("mean", self.mean)
        check_covariance("cov", self.cov, self.state_dim)

    def compute(self, *, batch_size):
        """Returns the belief."""
        return tuple(value.expand(*batch_size, *value.shape) for value in (self.mean, self.cov, self.cov.diagonal()))


class GaussianAround(Initial):
    """A Gaussian belief around a state that is known at reset, e.g. the ground truth of a data set.

    Like :class:`~torch_denkf.modules.AroundState`, for filters with a mean and a covariance.

    Args:
        std: standard deviations ``[S]``, in the state's units; zero where the state is known exactly.
        state_key: the known state ``[*B, S]``.
        space: space of the state; ``None`` for plain numbers. ``std`` is of the tangents.
        belief_prefix: prefix of ``mean`` ``[*B, S]``, ``cov`` ``[*B, S, S]`` (diagonal) and ``var`` ``[*B, S]``.

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
        self,
        std: Sequence[float] | torch.Tensor,
        *,
        state_key: NestedKey = "state",
        space: Space | None = None,
        belief_prefix: str = "belief",
    ):
        super().__init__(nn.Identity(), [state_key], [(belief_prefix, name) for name in ("mean", "cov", "var")])
        std = as_standard_deviations("std", std)
        self.register_buffer("std", std)
        self.space, self.state_dim = check_space("space", space), std.numel()
        if space is not None:
            space.check(tangent=std)
            self.input_dim = space.point_dim

    def compute(self, state):
        """Returns the belief."""
        mean = state.to(self.std.dtype)
        variance = self.std.square().expand(*mean.shape[:-1], -1) if self.space else self.std.square().expand_as(mean)
        return mean, variance.diag_embed(), variance


class LinearTransition(Transition):
    r"""Forecast of mean and covariance, :math:`F m + B a` and :math:`F P F^T + Q`.

    Args:
        matrix: F, ``[S, S]``.
        noise: Q, ``[S, S]``, or a module that writes it, see :mod:`torch_denkf.modules.process_noise`.
        control: B, ``[S, A]``; ``None`` for none.
        trainable: whether F and B are parameters.
        action_key: entry ``[*B, A]``, with ``control``.
        belief_prefix: prefix of ``mean`` and ``cov`` of the last analysis.
        forecast_prefix: prefix of ``mean`` and ``cov`` of the forecast.

    Raises:
        ValueError: if the shapes do not fit, a number is not finite, or ``noise`` is no covariance.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"belief": {"mean": torch.ones(1), "cov": torch.ones(1, 1)}})
        >>> LinearTransition(2 * torch.eye(1), torch.eye(1))(td)["forecast", "cov"]
        tensor([[5.]])
    """

    noise: torch.Tensor | TensorDictModuleBase

    def __init__(
        self,
        matrix: torch.Tensor,
        noise: torch.Tensor | TensorDictModuleBase,
        *,
        control: torch.Tensor | None = None,
        trainable: bool = False,
        action_key: NestedKey = "action",
        belief_prefix: str = "belief",
        forecast_prefix: str = "forecast",
    ):
        in_keys, out_keys = ([(key, name) for name in ("mean", "cov")] for key in (belief_prefix, forecast_prefix))
        in_keys += [] if control is None else [action_key]
        modules = [noise] if isinstance(noise, nn.Module) else []
        further, optional = further_keys(modules, [*in_keys, *out_keys])
        super().__init__(nn.Identity(), in_keys + further, out_keys, optional_keys=optional)
        self.action_key = unravel_key(action_key)
        register_constant(self, "matrix", matrix, trainable=trainable)
        register_constant(self, "control", control, trainable=trainable)
        check_square("matrix", self.matrix)
        check_values("matrix", self.matrix)
        if self.control is not None:
            size = self.control.shape[-1] if self.control.ndim else 0
            check_shape("control", self.control, (len(self.matrix), size), "[S, A]")
            check_values("control", self.control)
        if isinstance(noise, nn.Module):
            self.noise = noise
        else:
            register_constant(self, "noise", noise)
            check_covariance("noise", self.noise, len(self.matrix))

    def parts(self):
        """Returns the noise, if it is a module."""
        return {"noise": self.noise} if isinstance(self.noise, nn.Module) else {}

    def on_entries(self, entries, call):
        """Returns the forecast."""
        return self.with_link(entries, call, wanted=False)[0]

    def with_link(self, entries: Entries, call: Call, *, wanted: bool = True) -> tuple[Entries, Sequence[torch.Tensor]]:
        """Returns the forecast, and its linear relation to the state before, see :class:`GaussianTransition`."""
        mean, cov = entries.get(self.in_keys[0]), entries.get(self.in_keys[1])
        if mean is None or cov is None:
            mean, cov = self.values(entries)[:2]  # raises with a message that lists the entries
        noise = self.noise
        constant = noise if isinstance(noise, torch.Tensor) else torch.zeros_like(cov)
        # The noise of a module is added below, because it may depend on the forecast's mean.
        forecast, forecast_cov = kalman_predict(mean, cov, self.matrix, constant)
        if self.control is not None:
            forecast = forecast + self.required(entries, self.action_key).to(mean.dtype) @ self.control.mT
        if not isinstance(noise, torch.Tensor):
            written = run_module(noise, {**entries, self.out_keys[0]: forecast}, call.part("noise"))
            constant = as_covariance(written[unravel_key(noise.out_keys[0])], mean)
            forecast_cov = forecast_cov + constant
        written = {self.out_keys[0]: forecast, self.out_keys[1]: forecast_cov}
        if not wanted:
            return written, ()
        eye = torch.eye(cov.shape[-1], dtype=cov.dtype, device=cov.device)
        return written, (eye, cov, self.matrix, constant)


class KalmanAnalysis(Update):
    """The Kalman update of mean and covariance (Joseph form).

    Args:
        matrix: H, ``[O, S]``.
        noise: R, variances ``[O]`` or a covariance ``[O, O]``; ``None`` to read it from ``noise_variance_key``.
        trainable: whether H is a parameter.
        inflation: factor of the belief's standard deviations where anything is observed; 1 for none. It makes
            components that are never observed, such as a vehicle's position, grow without bound: there scale Q and R
            instead.
        reading_space: space of the reading, made of numbers and angles, such as ``Euclidean(1) * Circle()``;
            ``None`` for plain numbers.
        observation_key: readings ``[*B, O]``, or learned observations ``[*B, E, O]``, whose mean is used; in a filter
            these are stored under a key whose last name is ``"ensemble"``.
        noise_variance_key: R, variances ``[*B, O]`` or a covariance ``[*B, O, O]``, if ``noise`` is ``None``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``.
        forecast_prefix: prefix of ``mean`` and ``cov`` of the forecast.
        belief_prefix: prefix of ``mean``, ``cov`` and ``var``.
        info_prefix: prefix of ``innovation`` ``[*B, O]``, ``nis`` and ``log_likelihood`` ``[*B, 1]``.

    Raises:
        ValueError: if the shapes do not fit, a number is not finite, ``noise`` is no covariance, or ``inflation`` is
            not positive; for a ``reading_space`` of another kind or size.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({
        ...     "forecast": {"mean": torch.zeros(1), "cov": torch.ones(1, 1)},
        ...     "observation": torch.ones(1),
        ... })
        >>> KalmanAnalysis(torch.eye(1), torch.ones(1))(td)["belief", "mean"]
        tensor([0.5000])
    """

    info_prefix: str

    def __init__(
        self,
        matrix: torch.Tensor,
        noise: torch.Tensor | None,
        *,
        trainable: bool = False,
        inflation: float = 1.0,
        reading_space: Space | None = None,
        observation_key: NestedKey = "observation",
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        forecast_prefix: str = "forecast",
        belief_prefix: str = "belief",
        info_prefix: str = "info",
    ):
        super().__init__(
            nn.Identity(),
            [(forecast_prefix, "mean"), (forecast_prefix, "cov"), observation_key]
            + ([noise_variance_key] if noise is None else []),
            [(belief_prefix, name) for name in ("mean", "cov", "var")]
            + [(info_prefix, name) for name in ("innovation", "nis", "log_likelihood")],
            optional_keys=[observed_key],
        )
        self.inflation, self.info_prefix = inflation, info_prefix
        self.reading_space = check_space("reading_space", reading_space, flat=True)
        register_matrix(self, "matrix", matrix, "[O, S]", trainable=trainable)
        register_constant(self, "noise", noise)
        check_number("inflation", inflation, above=0)
        if self.reading_space is not None and self.reading_space.point_dim != len(self.matrix):
            raise ValueError(f"reading_space={reading_space} does not fit the {len(self.matrix)} rows of matrix.")
        if self.noise is not None and self.noise.ndim == 2:
            check_covariance("noise", self.noise, len(self.matrix), "[O] or [O, O]")
        elif self.noise is not None:
            check_shape("noise", self.noise, (len(self.matrix),), "[O]")
            check_values("noise", self.noise, least=0, cure="These are variances")
        self.reading_keys, self.observed_key = self.in_keys[2:], unravel_key(observed_key)

    def observe(self, state: torch.Tensor) -> torch.Tensor:
        """Returns ``H x`` for states ``[*, S]``; NaN for rows that use a dimension that is NaN."""
        return product_of_known(self.matrix, state)

    def reading_dims(self, entries, call):
        """Returns O, the number of rows of H."""
        return [len(self.matrix)] * len(self.reading_keys)

    def compute(self, mean, cov, observation, *rest):
        """Returns the belief and the diagnostics."""
        *noise, observed = rest
        noise = noise[0] if noise else self.noise.expand(*mean.shape[:-1], *self.noise.shape)
        if observation.ndim > mean.ndim:
            observation = mean_reading(self.reading_space, observation, None)
        if self.reading_space is not None:  # on the same turn as the prediction
            predicted = mean @ self.matrix.mT
            observation = predicted + self.reading_space.minus(observation, predicted)
        update = kalman_update(mean, cov, observation, self.matrix, noise, observed=observed)
        return updated(update, observed, self.inflation)
