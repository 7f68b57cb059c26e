r"""Process noise of an ensemble, for transitions that have none or too little."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, cast

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_shape
from torch_denkf.functional.draws import exact_draws, is_exact
from torch_denkf.functional.linalg import as_covariance, semidefinite_root
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.functional.weighted import weighted_mean
from torch_denkf.modules.noise import ConstantNoise
from torch_denkf.modules.process_noise import NoiseThrough, as_process_noise
from torch_denkf.modules.tensors import check_dims
from torch_denkf.running import check_module, reads, run_module, runs_as_written
from torch_denkf.submodel import Call, Entries, Transition

__all__ = ["NoisyTransition"]


class NoisyTransition(Transition):
    r"""A transition with Gaussian process noise :math:`N(0, Q)` in some or all dimensions of the state.

    An ensemble without process noise collapses: its members approach each other, and its intervals become too narrow.
    This adds noise to a transition that has none, or too little; Q comes from the same modules as in a filter with a
    covariance.

    Args:
        transition: forecasts an ensemble, ``("belief", "ensemble")`` to ``("forecast", "ensemble")``; its keys are
            kept.
        noise: standard deviations ``[N]``, with N the number of ``dims``, or a module that writes Q: variances
            ``[*B, N]`` or a covariance ``[*B, N, N]``, see :mod:`torch_denkf.modules.process_noise`. It may read the
            belief's (weighted) mean at ``mean_key`` and, unless ``before``, the forecast's at ``forecast_mean_key``,
            which are computed for it.
        dims: state dimensions of the noise, in the order of Q; ``None`` for all.
        before: True adds the noise to the state *before* the transition, so that it also reaches dimensions that
            depend on the noisy ones, such as the pose of a vehicle on its velocities.
        mean_key: the belief's mean ``[*B, S]``.
        forecast_mean_key: the mean of the forecast before the noise, ``[*B, S]``.
        log_weight_key: optional log-weights of the belief ``[*B, E]``.
        space: space of the state; ``None`` for plain numbers. Noise and ``dims`` are of the tangents.
        draws: ``"exact"`` or ``"random"``, see :func:`~torch_denkf.functional.draws.exact_draws`; weighted particles
            draw at random.

    Raises:
        KeyError: if an entry is missing.
        ValueError: if ``noise`` does not write one variance for each dimension, or ``dims`` names one twice.

    Reference:
        Learned motion noise of a particle filter: Jonschkowski, Rastogi & Brock 2018, arXiv:1805.11122 (there a
        sampler); Kloss, Martius & Bohg 2021, arXiv:2012.14313 (the diagonal of Q).

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import LearnedTransition
        >>> still = LearnedTransition(nn.Linear(2, 2))
        >>> noisy = NoisyTransition(still, [0.1], dims=[1])
        >>> td = TensorDict({("belief", "ensemble"): torch.zeros(100, 2)})
        >>> noisy(td)["forecast", "ensemble"].std(0) > 0.05
        tensor([False,  True])
    """

    noise_names = ("",)

    def __init__(
        self,
        transition: TensorDictModuleBase,
        noise: TensorDictModuleBase | Sequence[float] | torch.Tensor,
        dims: Sequence[int] | None = None,
        *,
        before: bool = False,
        mean_key: NestedKey = ("belief", "mean"),
        forecast_mean_key: NestedKey = ("forecast", "mean"),
        log_weight_key: NestedKey = ("belief", "log_weight"),
        space: Space | None = None,
        draws: Literal["exact", "random"] = "exact",
    ):
        check_module("transition", transition)
        noise = as_process_noise(noise, None if dims is None else len(dims), "noise", mean_key)
        check_module("noise", noise)
        self_made = {unravel_key(mean_key), unravel_key(forecast_mean_key)}
        needed, optional = reads(transition)
        of_noise, of_noise_optional = reads(noise)
        super().__init__(
            nn.ModuleDict({"transition": transition, "noise": noise}),
            list(dict.fromkeys([*needed, *(key for key in of_noise if key not in self_made)])),
            transition.out_keys,
            optional_keys=[log_weight_key, *optional, *of_noise_optional],
        )
        self.log_weight_key, self.space = unravel_key(log_weight_key), check_space("space", space)
        self.before, self.mean_key, self.forecast_mean_key = before, *map(unravel_key, (mean_key, forecast_mean_key))
        check_dims("dims", dims or (), once=True)
        self.exact = is_exact(draws)
        self.register_buffer("dims", None if dims is None else torch.tensor(list(dims)), persistent=False)

    def draw_noise(self, batch_size, *, members=None, state_dim=None, device=None, dtype=None, generator=None, **_):
        """Draws standard-normal values ``[*batch_size, E, N]``; ``None`` if E or the state's size is not known."""
        size = state_dim if self.dims is None else len(self.dims)
        if members is None or size is None:
            return None
        size = min(size, self.noise_dim or size)
        return torch.randn(*batch_size, members, size, device=device, dtype=dtype, generator=generator)

    @property
    def noise_dim(self) -> int | None:
        """Returns N for noise that is mapped by a matrix; ``None`` for any other noise module."""
        noise = self.module["noise"]
        mapped = isinstance(noise, NoiseThrough) and type(noise).on_entries is NoiseThrough.on_entries
        return noise.noise_dim if mapped and runs_as_written(noise) else None

    def noise_sizes(self, ensemble, *_):
        """Returns E, and the state's size."""
        return {"members": ensemble.shape[-2], "state_dim": ensemble.shape[-1]}

    def parts(self):
        """Returns the transition and the noise module."""
        return dict(self.module.items())

    def on_entries(self, entries, call):
        """Returns the forecast ensemble, and all other outputs of the transition."""
        key, out_key = unravel_key(self.in_keys[0]), unravel_key(self.out_keys[0])
        state, entries = self.required(entries, key), dict(entries)
        log_weights = entries.get(self.log_weight_key)
        entries[self.mean_key] = self._mean(self.mean_key, state, log_weights)
        if self.before:
            entries[key] = self._add(state, entries, call)
        written = run_module(self.module["transition"], entries, call.part("transition"))
        if not self.before:
            moved = written[out_key]
            entries[self.forecast_mean_key] = self._mean(self.forecast_mean_key, moved, log_weights)
            written = {**written, out_key: self._add(moved, entries, call)}
        return written

    def _mean(self, key: NestedKey, members: torch.Tensor, log_weights: torch.Tensor | None) -> torch.Tensor:
        """Returns the mean for the parts, or any member if no part uses its values."""
        parts = [part for part in self.module.values() if type(part) is not ConstantNoise]  # it uses only the dtype
        if not any(key in keys for part in parts for keys in reads(part)):
            return members[..., 0, :]
        if self.space is not None:
            return self.space.mean(members, None if log_weights is None else log_weights.exp())
        return members.mean(-2) if log_weights is None else weighted_mean(members, log_weights)

    def _add(self, ensemble: torch.Tensor, entries: Entries, call: Call) -> torch.Tensor:
        """Returns the ensemble with process noise."""
        space, model, inside = self.space, self.module["noise"], call.part("noise")
        whole = ensemble.shape[-1] if space is None else space.tangent_dim
        size = whole if self.dims is None else len(self.dims)
        few = self.noise_dim is not None and self.noise_dim < size
        written, matrix = model.unmapped(entries, inside) if few else (run_module(model, entries, inside), None)
        covariance = written[unravel_key(model.out_keys[0])]
        width = (covariance if matrix is None else matrix.mT).shape[-1]
        if width != size:
            dims = "all" if self.dims is None else self.dims.tolist()
            raise ValueError(
                f"The noise model writes {width} variances in {model.out_keys[0]!r} for {size} dims; "
                f"give it an output for each of dims={dims}."
            )
        normal = cast("torch.Tensor | None", self._noise(entries, [ensemble], call))
        if normal is None:
            return ensemble
        normal = normal[..., : covariance.shape[-1]]  # a point may have more components than its tangent
        check_shape(f"noise {call.place!r}", normal, (*ensemble.shape[:-1], covariance.shape[-1]), "[*B, E, N]")
        if self.exact and not call.raw and self.log_weight_key not in entries:
            away = ensemble if space is None else space.minus(ensemble, space.near(ensemble).unsqueeze(-2))
            normal = exact_draws(normal, away)
        if covariance.ndim == len(call.batch_size) + 1:
            noise = covariance.sqrt().unsqueeze(-2) * normal
        else:
            noise = normal @ semidefinite_root(as_covariance(covariance, covariance[..., 0])).mT
        noise = noise if matrix is None else noise @ matrix.mT
        if self.dims is not None:
            noise = noise.new_zeros(*noise.shape[:-1], whole).index_add(-1, self.dims, noise)
        return ensemble + noise if space is None else space.plus(ensemble, noise)
