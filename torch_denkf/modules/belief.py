r"""Initial beliefs: the first ensemble :math:`X_0 = [x^1_0, \dots, x^E_0]` of an episode."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, unravel_key
from torch import nn

from torch_denkf._checks import check_count, check_shape, check_values
from torch_denkf.beliefs import moments_of
from torch_denkf.functional.draws import exact_draws, is_exact
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.modules.tensors import (
    as_floating,
    as_standard_deviations,
    check_dims,
    mean_of_members,
    register_constant,
)
from torch_denkf.submodel import Initial

__all__ = ["AroundState", "FromSensor", "GaussianPrior"]


class _InitialEnsemble(Initial):
    """Draws ``center + std * N(0, I)`` and writes ensemble, mean and variance of the belief."""

    def __init__(
        self,
        std: Sequence[float] | torch.Tensor,
        ensemble_size: int,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey],
        optional_keys: Sequence[NestedKey] = (),
        space: Space | None = None,
        draws: Literal["exact", "random"] = "exact",
    ):
        super().__init__(nn.Identity(), in_keys, out_keys, optional_keys=optional_keys)
        std = as_standard_deviations("std", std)
        self.space = check_space("space", space)
        if space is not None:
            space.check(tangent=std)
        check_count("ensemble_size", ensemble_size, least=2, cure="One member has no variance")
        self.exact = is_exact(draws)
        self.register_buffer("std", std)
        self.ensemble_size, self.state_dim = ensemble_size, std.numel()

    noise_names = ("",)

    def draw_noise(self, batch_size, *, device=None, dtype=None, generator=None, **_):
        """Draws standard-normal values ``[*batch_size, E, S]``."""
        shape = (*batch_size, self.ensemble_size, self.state_dim)
        return torch.randn(shape, device=device, dtype=dtype, generator=generator)

    def _members(self, center: torch.Tensor, std: torch.Tensor, noise: torch.Tensor | None, batch_size):
        """Returns ensemble, mean and variance."""
        if noise is None:
            noise = self.draw_noise(batch_size, device=center.device, dtype=center.dtype)
        check_shape("the initial noise", noise, (*batch_size, self.ensemble_size or 0, std.shape[-1]), "[*B, E, S]")
        noise = noise.to(center.dtype)
        away = std.unsqueeze(-2) * (exact_draws(noise) if self.exact else noise)
        center = center.unsqueeze(-2)
        ensemble = center + away if self.space is None else self.space.plus(center, away)
        return ensemble, *moments_of(ensemble, space=self.space)


_BELIEF_KEYS = (("belief", "ensemble"), ("belief", "mean"), ("belief", "var"))


class GaussianPrior(_InitialEnsemble):
    """A Gaussian prior with a diagonal covariance, the same for every episode.

    Args:
        mean: ``[S]``, in the state's units.
        std: standard deviations ``[S]``.
        ensemble_size: E.
        space: space of the state; ``None`` for plain numbers. ``mean`` is a point, ``std`` is of the tangents.
        draws: ``"exact"`` or ``"random"``, see :func:`~torch_denkf.functional.draws.exact_draws`.
        out_keys: ensemble ``[*B, E, S]``, mean ``[*B, S]``, variance ``[*B, S]``.

    Example:
        >>> from tensordict import TensorDict
        >>> prior = GaussianPrior([0.0, 0.0], std=[1.0, 2.0], ensemble_size=16)
        >>> prior(TensorDict({}, [3]))["belief", "ensemble"].shape
        torch.Size([3, 16, 2])
    """

    def __init__(
        self,
        mean: Sequence[float] | torch.Tensor,
        std: Sequence[float] | torch.Tensor,
        *,
        ensemble_size: int = 32,
        space: Space | None = None,
        draws: Literal["exact", "random"] = "exact",
        out_keys: Sequence[NestedKey] = _BELIEF_KEYS,
    ):
        super().__init__(std, ensemble_size, [], out_keys, space=space, draws=draws)
        mean = as_floating(mean, "mean")
        if space is not None:
            space.check(mean=mean)
        elif mean.shape != self.std.shape:
            raise ValueError(f"mean and std differ in shape: {list(mean.shape)} and {list(self.std.shape)}.")
        check_values("mean", mean)
        self.register_buffer("mean", mean)

    def compute(self, *, noise, batch_size):
        """Returns the belief."""
        return self._members(self.mean.expand(*batch_size, -1), self.std, noise, batch_size)


class AroundState(_InitialEnsemble):
    """A belief around a state that is known at reset, e.g. the ground truth of a data set.

    Args:
        std: standard deviations ``[S]``, in the state's units.
        ensemble_size: E.
        state_key: the known state ``[*B, S]``.
        space: space of the state; ``None`` for plain numbers. ``std`` is of the tangents.
        draws: ``"exact"`` or ``"random"``, see :func:`~torch_denkf.functional.draws.exact_draws`.
        out_keys: ensemble ``[*B, E, S]``, mean ``[*B, S]``, variance ``[*B, S]``.

    Raises:
        KeyError: if ``state_key`` is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> around = AroundState([0.0, 0.0])
        >>> around(TensorDict({"state": torch.tensor([1.0, 2.0])}))["belief", "mean"]
        tensor([1., 2.])
    """

    def __init__(
        self,
        std: Sequence[float] | torch.Tensor,
        *,
        ensemble_size: int = 32,
        state_key: NestedKey = "state",
        space: Space | None = None,
        draws: Literal["exact", "random"] = "exact",
        out_keys: Sequence[NestedKey] = _BELIEF_KEYS,
    ):
        super().__init__(std, ensemble_size, [state_key], out_keys, space=space, draws=draws)
        if space is not None:
            self.input_dim = space.point_dim

    def compute(self, state, *, noise, batch_size):
        """Returns the belief."""
        return self._members(state.to(self.std.dtype), self.std, noise, batch_size)


class FromSensor(_InitialEnsemble):
    """A belief from the first sensor reading: observed dimensions N(mean reading, R), the others a Gaussian prior.

    If nothing is observed at reset, only the prior is used, as with ``filter.initialise(..., without=[...])``.

    Args:
        dims: state dimensions that the sensor observes, in the observation's order.
        mean: prior mean ``[S]``, in the state's units.
        std: prior standard deviations ``[S]``.
        ensemble_size: E.
        observation_key: learned observations ``[*B, E, O]`` or a reading ``[*B, O]``.
        noise_variance_key: variances ``[*B, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``.
        draws: ``"exact"`` or ``"random"``, see :func:`~torch_denkf.functional.draws.exact_draws`.
        out_keys: ensemble ``[*B, E, S]``, mean ``[*B, S]``, variance ``[*B, S]``.

    Raises:
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> start = FromSensor([0], mean=[0.0, 0.0], std=[1.0, 0.0], ensemble_size=1000)
        >>> td = TensorDict({"sensor": {"ensemble": torch.tensor([5.0]), "noise": torch.tensor([0.01])}})
        >>> start(td)["belief", "mean"].round(decimals=1)
        tensor([5., 0.])
    """

    def __init__(
        self,
        dims: Sequence[int],
        mean: Sequence[float] | torch.Tensor,
        std: Sequence[float] | torch.Tensor,
        *,
        ensemble_size: int = 32,
        observation_key: NestedKey = ("sensor", "ensemble"),
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        draws: Literal["exact", "random"] = "exact",
        out_keys: Sequence[NestedKey] = _BELIEF_KEYS,
    ):
        super().__init__(
            std, ensemble_size, [observation_key, noise_variance_key], out_keys, [observed_key], draws=draws
        )
        register_constant(self, "mean", mean)
        check_values("mean", self.mean)
        check_dims("dims", dims, once=True, size=self.state_dim)
        self.register_buffer("dims", torch.tensor(list(dims)), persistent=False)
        self.input_dim, self.observed_key = len(self.dims), unravel_key(observed_key)

    def compute(self, reading, variance, observed=None, *, noise, batch_size):
        """Returns the belief."""
        reading, std = mean_of_members(reading, batch_size), variance.sqrt()
        mean, prior_std = (part.expand(*reading.shape[:-1], -1) for part in (self.mean, self.std))
        if observed is not None:
            reading = torch.where(observed, reading, mean.index_select(-1, self.dims))
            std = torch.where(observed, std, prior_std.index_select(-1, self.dims))
        center = mean.index_copy(-1, self.dims, reading.to(mean.dtype))
        return self._members(center, prior_std.index_copy(-1, self.dims, std.to(mean.dtype)), noise, batch_size)
