"""What the filters with a mean and a covariance share: they run ensemble modules, and add Q and R."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf.functional import GaussianUpdate
from torch_denkf.modules._base import SubModel
from torch_denkf.modules.stochastic import FlipoutLinear, StochasticMLP, deterministic


class GaussianTransition(SubModel):
    """Forecasts mean and covariance through a transition of ensembles; a subclass writes :meth:`_forecast`."""

    def __init__(
        self,
        transition: TensorDictModuleBase,
        process_noise: TensorDictModuleBase,
        *,
        belief_key: str = "belief",
        forecast_key: str = "forecast",
        ensemble_key: NestedKey = ("belief", "ensemble"),
        forecast_ensemble_key: NestedKey = ("forecast", "ensemble"),
    ):
        refuse_random_layers(transition, type(self).__name__)
        in_keys, out_keys = ([(key, name) for name in ("mean", "cov")] for key in (belief_key, forecast_key))
        self_made = [unravel_key(ensemble_key), *out_keys]
        in_keys += further_keys((transition, process_noise), [*in_keys, *self_made])
        super().__init__(transition, in_keys, out_keys)
        self.process_noise = process_noise
        self.ensemble_key, self.forecast_ensemble_key = ensemble_key, forecast_ensemble_key

    runs_on_rows = True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the forecast."""
        mean, cov = (self.read(tensordict, key) for key in self.in_keys[:2])
        with deterministic(self.module):
            mean, cov = self._forecast(tensordict, mean, cov)
        work = tensordict.copy().set(self.out_keys[0], mean)
        cov = cov + as_covariance(self.read(self.process_noise(work), self.process_noise.out_keys[0]), mean)
        tensordict.set(self.out_keys[0], mean)
        return tensordict.set(self.out_keys[1], cov)

    def _forecast(self, tensordict, mean, cov) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean and covariance before the process noise is added."""
        raise NotImplementedError

    def _move(self, tensordict: TensorDictBase, states: torch.Tensor) -> torch.Tensor:
        """The transition of an ensemble ``[*B, E, S]``; writes into ``tensordict``."""
        return self.read(self.module(tensordict.set(self.ensemble_key, states)), self.forecast_ensemble_key)


class GaussianAnalysis(SubModel):
    """Updates mean and covariance through an observation model of ensembles; a subclass writes :meth:`_update`."""

    def __init__(
        self,
        observation: TensorDictModuleBase,
        *,
        inflation: float = 1.0,
        angles: Sequence[int] = (),
        observation_key: NestedKey = ("sensor", "ensemble"),
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        forecast_key: str = "forecast",
        belief_key: str = "belief",
        info_key: str = "info",
        ensemble_key: NestedKey = ("forecast", "ensemble"),
        predicted_key: NestedKey = ("forecast", "observation"),
    ):
        refuse_random_layers(observation, type(self).__name__)
        in_keys = [(forecast_key, "mean"), (forecast_key, "cov"), observation_key, noise_variance_key]
        in_keys += further_keys([observation], [*in_keys, ensemble_key])
        out_keys = [(belief_key, name) for name in ("mean", "cov", "var")]
        out_keys += [(info_key, name) for name in ("innovation", "nis", "log_likelihood")]
        super().__init__(observation, in_keys, out_keys, optional_keys=[observed_key])
        self.inflation, self.angles = inflation, list(angles)
        self.ensemble_key, self.predicted_key = ensemble_key, predicted_key

    runs_on_rows = True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Writes the belief and the diagnostics."""
        mean, cov, observation, noise = (self.read(tensordict, key) for key in self.in_keys[:4])
        if observation.ndim > mean.ndim:
            observation = observation.mean(-2)
        with deterministic(self.module):
            update, observed = self._update(tensordict, mean, cov, observation, noise)
        write_update(self, tensordict, update, observed, self.inflation)
        return tensordict

    def _update(self, tensordict, mean, cov, observation, noise) -> tuple[GaussianUpdate, torch.Tensor | None]:
        """The update, and the mask that it used."""
        raise NotImplementedError

    def _observe(self, tensordict: TensorDictBase, states: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Predicted observations ``[*B, E, O]`` of an ensemble, and the mask after the model ran; writes."""
        out = self.module(tensordict.set(self.ensemble_key, states))
        return self.read(out, self.predicted_key), out.get(self.optional_keys[0], None)


def write_update(
    module: SubModel,
    tensordict: TensorDictBase,
    update: GaussianUpdate,
    observed: torch.Tensor | None,
    inflation: float = 1.0,
) -> None:
    """Writes mean, cov, var, innovation, nis and log_likelihood under the module's ``out_keys``.

    ``inflation`` multiplies the belief's standard deviations where anything is observed.
    """
    cov = update.cov
    if inflation != 1.0:
        inflated = inflation**2 * cov
        cov = inflated if observed is None else torch.where(observed.any(-1)[..., None, None], inflated, cov)
    variance = cov.diagonal(dim1=-2, dim2=-1)
    values = (update.mean, cov, variance, update.innovation, update.nis, update.log_likelihood)
    for key, value in zip(module.out_keys, values, strict=True):
        tensordict.set(key, value)


def as_covariance(noise: torch.Tensor, mean: torch.Tensor) -> torch.Tensor:
    """Covariance ``[*B, N, N]`` from variances ``[*B, N]``, or as it is; ``mean`` ``[*B, S]`` tells them apart."""
    return noise.diag_embed() if noise.ndim == mean.ndim else noise


def further_keys(modules: Iterable[TensorDictModuleBase], known: Iterable[NestedKey]) -> list[NestedKey]:
    """What ``modules`` read beside the entries ``known``."""
    known = set(map(unravel_key, known))
    keys = [unravel_key(key) for module in modules for key in module.in_keys]
    return [key for key in dict.fromkeys(keys) if key not in known]


def refuse_random_layers(module: nn.Module, owner: str) -> None:
    """Raises where a module would stay random although its stochastic networks run their deterministic forward.

    Raises:
        ValueError: if there are dropout or flipout layers outside a :class:`StochasticMLP`, or sub-models that draw
            noise without one.
    """
    networks = [part for part in module.modules() if isinstance(part, StochasticMLP)]
    inside = {layer for network in networks for layer in network.modules()}
    kinds = (nn.modules.dropout._DropoutNd, FlipoutLinear)
    random = [
        name or type(part).__name__
        for name, part in module.named_modules()
        if (isinstance(part, kinds) and part not in inside) or (isinstance(part, SubModel) and _draws(part, networks))
    ]
    if random:
        raise ValueError(
            f"{owner} needs a deterministic model; {type(module).__name__} holds random parts ({random}). Put random "
            "layers into a StochasticMLP, whose mean network is then used, or take them out: the noise of this filter "
            "is in its covariances."
        )


def _draws(part: SubModel, networks: list[StochasticMLP]) -> bool:
    """Whether a sub-model, asked for the noise of one member, draws any that is not a network's."""
    if part.noise_key is None or part.module in networks:
        return False
    size = getattr(part, "ensemble_size", 1)
    if size is None:
        part.ensemble_size = 1
    try:
        with torch.random.fork_rng(devices=[]):
            return part.draw_noise(()) is not None
    finally:
        if size is None:
            part.ensemble_size = None
