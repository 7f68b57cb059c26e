"""Base classes of steps on a mean and a covariance, which run ensemble modules and add Q and R."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypedDict

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_number
from torch_denkf.functional.gaussian import GaussianUpdate, sandwich
from torch_denkf.functional.linalg import as_covariance
from torch_denkf.functional.manifolds import Space, check_space, is_flat
from torch_denkf.modules.spaces import mean_reading, narrowed_mask
from torch_denkf.modules.stochastic import FlipoutLinear, StochasticMLP, deterministic
from torch_denkf.running import check_module, reads, run_module, writes
from torch_denkf.submodel import Call, Entries, SubModel, Transition, Update

_DROPOUTS = (nn.Dropout, nn.Dropout1d, nn.Dropout2d, nn.Dropout3d, nn.AlphaDropout, nn.FeatureAlphaDropout)


class GaussianTransitionKeys(TypedDict, total=False):
    """The keys of a forecast of mean and covariance.

    Attributes:
        belief_prefix: prefix of ``mean`` ``[*B, S]`` and ``cov`` ``[*B, S, S]`` of the last analysis; ``"belief"`` by
            default.
        forecast_prefix: prefix of ``mean`` and ``cov`` of the forecast, ``"forecast"`` by default.
        ensemble_key: input of the transition, ``("belief", "ensemble")`` by default.
        forecast_ensemble_key: its output, ``("forecast", "ensemble")`` by default.
        space: space of the state; ``None`` by default, for plain numbers. Covariances and Q are of tangents.
    """

    belief_prefix: str
    forecast_prefix: str
    ensemble_key: NestedKey
    forecast_ensemble_key: NestedKey
    space: Space | None


class GaussianTransition(Transition):
    """Forecasts mean and covariance through a transition of ensembles; a subclass implements :meth:`_forecast`.

    Args:
        transition: forecasts ensembles ``[*B, E, S]``, e.g. :class:`~torch_denkf.modules.LearnedTransition`.
        process_noise: writes Q, variances ``[*B, S]`` or a covariance ``[*B, S, S]``, see
            :mod:`torch_denkf.modules.process_noise`; it may read the belief's mean and the forecast's.
        **keys: see :class:`GaussianTransitionKeys`.

    Raises:
        ValueError: if the transition has random layers outside a :class:`~torch_denkf.modules.StochasticMLP`, or
            draws its own noise.
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        process_noise: TensorDictModuleBase,
        *,
        belief_prefix: str = "belief",
        forecast_prefix: str = "forecast",
        ensemble_key: NestedKey = ("belief", "ensemble"),
        forecast_ensemble_key: NestedKey = ("forecast", "ensemble"),
        space: Space | None = None,
    ):
        check_module("transition", transition)
        check_module("process_noise", process_noise)
        check_no_random_layers(transition, type(self).__name__)
        in_keys, out_keys = ([(key, name) for name in ("mean", "cov")] for key in (belief_prefix, forecast_prefix))
        self_made = [unravel_key(ensemble_key), *out_keys]
        further, optional = further_keys((transition, process_noise), [*in_keys, *self_made])
        super().__init__(transition, in_keys + further, out_keys, optional_keys=optional)
        self.process_noise, self.space = process_noise, check_space("space", space)
        self.ensemble_key, self.forecast_ensemble_key = map(unravel_key, (ensemble_key, forecast_ensemble_key))

    def parts(self):
        """Returns the process noise; the transition is deterministic."""
        return {"process_noise": self.process_noise}

    def on_entries(self, entries, call):
        """Returns the forecast."""
        return self.with_link(entries, call, wanted=False)[0]

    def with_link(self, entries: Entries, call: Call, *, wanted: bool = True) -> tuple[Entries, Sequence[torch.Tensor]]:
        """Returns the forecast; and, if wanted, its linear relation to the state before: A, M, B and Q.

        The covariance before is A M Aᵀ, the covariance of the states before and after is A M Bᵀ, and the forecast's is
        B M Bᵀ + Q.
        """
        mean, cov = (self.required(entries, key) for key in self.in_keys[:2])
        mean, cov, link = self._forecast(entries, mean, cov, call._replace(sample=False), wanted)
        work = {**entries, self.out_keys[0]: mean}
        written = run_module(self.process_noise, work, call.part("process_noise"))
        noise = as_covariance(written[unravel_key(self.process_noise.out_keys[0])], mean)
        return {self.out_keys[0]: mean, self.out_keys[1]: cov + noise}, (*(link or ()), noise)

    def mask_of(self, entries: Entries, written: Entries) -> None:
        """Returns ``None``: a forecast has no mask."""

    def _forecast(
        self, entries: Entries, mean, cov, call: Call, wanted: bool
    ) -> tuple[torch.Tensor, torch.Tensor, Sequence[torch.Tensor] | None]:
        """Returns mean and covariance before the process noise is added, and if wanted A, M and B."""
        raise NotImplementedError

    def _move(self, entries: Entries, states: torch.Tensor, call: Call) -> torch.Tensor:
        """Returns the forecast of an ensemble ``[*B, E, S]`` by the transition."""
        with deterministic(self.module):  # for networks that do not read ``call.sample``
            return run_module(self.module, {**entries, self.ensemble_key: states}, call)[self.forecast_ensemble_key]


class GaussianAnalysisOptions(TypedDict, total=False):
    """Options of an update of mean and covariance, in addition to the observation model.

    Attributes:
        inflation: factor of the belief's standard deviations where anything is observed; 1 by default, for none. It
            makes components that are never observed, such as a vehicle's position, grow without bound: there scale Q
            and R instead.
        space: space of the state; ``None`` by default, for plain numbers. ``cov`` and ``var`` are of the tangents
            at ``mean``.
        reading_space: space of the reading, such as ``Circle()`` for an angle, whose innovation is wrapped to
            [-pi, pi); ``None`` by default, for plain numbers. Innovation and R are tangents.
        observation_key: learned observations ``[*B, E, O]``, whose mean is used, or readings ``[*B, O]``;
            ``("sensor", "ensemble")`` by default.
        noise_variance_key: R, variances ``[*B, O]`` or a covariance ``[*B, O, O]``; ``("sensor", "noise")`` by default.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``, read after the observation model has run;
            ``"observed"`` by default.
        forecast_prefix: prefix of ``mean`` and ``cov`` of the forecast, ``"forecast"`` by default.
        belief_prefix: prefix of ``mean`` ``[*B, S]``, ``cov`` ``[*B, S, S]`` and ``var`` ``[*B, S]``; ``"belief"`` by
            default.
        info_prefix: prefix of ``innovation`` ``[*B, O]``, ``nis`` and ``log_likelihood`` ``[*B, 1]``; ``"info"`` by
            default.
        ensemble_key: input of the observation model, ``("forecast", "ensemble")`` by default.
        predicted_key: its output, ``("forecast", "observation")`` by default.
    """

    inflation: float
    space: Space | None
    reading_space: Space | None
    observation_key: NestedKey
    noise_variance_key: NestedKey
    observed_key: NestedKey
    forecast_prefix: str
    belief_prefix: str
    info_prefix: str
    ensemble_key: NestedKey
    predicted_key: NestedKey


class GaussianAnalysis(Update):
    """Updates mean and covariance through an observation model of ensembles; a subclass implements :meth:`_update`.

    Args:
        observation: observes ensembles ``[*B, E, S]``. Its other inputs and outputs, such as a mask, are read from and
            written to a copy of the tensordict.
        **options: see :class:`GaussianAnalysisOptions`.

    Raises:
        ValueError: if the model has random layers outside a :class:`~torch_denkf.modules.StochasticMLP`.
        KeyError: if an entry is missing.
    """

    def __init__(
        self,
        observation: TensorDictModuleBase,
        *,
        inflation: float = 1.0,
        space: Space | None = None,
        reading_space: Space | None = None,
        observation_key: NestedKey = ("sensor", "ensemble"),
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        forecast_prefix: str = "forecast",
        belief_prefix: str = "belief",
        info_prefix: str = "info",
        ensemble_key: NestedKey = ("forecast", "ensemble"),
        predicted_key: NestedKey = ("forecast", "observation"),
    ):
        check_module("observation", observation)
        check_no_random_layers(observation, type(self).__name__)
        in_keys = [(forecast_prefix, "mean"), (forecast_prefix, "cov"), observation_key, noise_variance_key]
        further, optional = further_keys([observation], [*in_keys, ensemble_key])
        out_keys = [(belief_prefix, name) for name in ("mean", "cov", "var")]
        out_keys += [(info_prefix, name) for name in ("innovation", "nis", "log_likelihood")]
        super().__init__(observation, in_keys + further, out_keys, optional_keys=[observed_key, *optional])
        check_number("inflation", inflation, above=0)
        self.inflation, self.info_prefix = inflation, info_prefix
        self.space, self.reading_space = check_space("space", space), check_space("reading_space", reading_space)
        self.ensemble_key, self.predicted_key = unravel_key(ensemble_key), unravel_key(predicted_key)
        self.reading_keys, self.observed_key = self.in_keys[2:4], unravel_key(observed_key)

    def on_entries(self, entries, call):
        """Returns the belief and the diagnostics."""
        mean, cov, observation, noise = (self.required(entries, key) for key in self.in_keys[:4])
        if observation.ndim > mean.ndim:
            observation = mean_reading(self.reading_space, observation, entries.get(self.observed_key))
        update, observed = self._update(entries, mean, cov, observation, noise, call._replace(sample=False))
        values = updated(update, observed, self.inflation)
        return dict(zip(self.out_keys, values, strict=True))

    def _innovation(
        self, observation: torch.Tensor, predicted: torch.Tensor, observed: torch.Tensor | None
    ) -> torch.Tensor:
        """Computes the innovation ``[*B, O]`` from predictions ``[*B, Q]``, with angles wrapped."""
        space = self.reading_space
        return observation - predicted if space is None else space.innovation(observation, predicted, observed)

    def _moved(self, mean: torch.Tensor, update: GaussianUpdate) -> GaussianUpdate:
        """Converts an update in tangents at ``mean`` to a point and the covariance of the tangents at that point."""
        if self.space is None:
            return update._replace(mean=mean + update.mean)
        if is_flat(self.space):
            return update._replace(mean=self.space.plus(mean, update.mean))
        move, turn = self.space.exp_and_jacobian(update.mean)
        cov = sandwich(turn, update.cov)
        return update._replace(mean=self.space.compose(mean, move), cov=(cov + cov.mT) / 2)

    def reading_dims(self, entries, call):
        """Returns the size of the model's predictions, O, and of the noise."""
        mean = self.required(entries, self.in_keys[0])
        size = self._observe(entries, mean.unsqueeze(-2), call._replace(sample=False))[0].shape[-1]
        return [size, size if self.reading_space is None else self.reading_space.tangent_dim]

    def with_mask(self, entries, call):
        """Returns the entries with the mask, if the observation model computes it."""
        if self.observed_key not in writes(self.module):
            return entries
        mean = self.required(entries, self.in_keys[0])
        mask = self._observe(entries, mean.unsqueeze(-2), call._replace(sample=False))[1]
        return entries if mask is None else {**entries, self.observed_key: mask}

    def _update(
        self, entries: Entries, mean, cov, observation, noise, call: Call
    ) -> tuple[GaussianUpdate, torch.Tensor | None]:
        """Returns the update, and the mask that it used."""
        raise NotImplementedError

    def _observe(self, entries: Entries, states: torch.Tensor, call: Call) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Returns the predicted observations ``[*B, E, O]`` of an ensemble, and the mask after the model ran."""
        with deterministic(self.module):
            written = run_module(self.module, {**entries, self.ensemble_key: states}, call)
        return written[self.predicted_key], self.mask_of(entries, written)

    def mask_of(self, entries: Entries, written: Entries) -> torch.Tensor | None:
        """Returns the mask of the observation model, combined with the given one."""
        given, made = entries.get(self.observed_key), written.get(self.observed_key)
        return narrowed_mask(self.reading_space, given if made is None else made if given is None else made & given)


def updated(update: GaussianUpdate, observed: torch.Tensor | None, inflation: float = 1.0) -> tuple[torch.Tensor, ...]:
    """Returns mean, cov, var, innovation, nis and log_likelihood.

    ``inflation`` multiplies the belief's standard deviations if anything is observed.
    """
    cov = update.cov
    if inflation != 1.0:
        inflated = inflation**2 * cov
        cov = inflated if observed is None else torch.where(observed.any(-1)[..., None, None], inflated, cov)
    return update.mean, cov, cov.diagonal(dim1=-2, dim2=-1), update.innovation, update.nis, update.log_likelihood


def further_keys(
    modules: Iterable[TensorDictModuleBase], known: Iterable[NestedKey]
) -> tuple[list[NestedKey], list[NestedKey]]:
    """Returns the required and the optional keys of ``modules``, without the entries ``known``."""
    known, read = set(map(unravel_key, known)), list(map(reads, modules))
    needed, optional = ([key for keys in read for key in keys[kind] if key not in known] for kind in (0, 1))
    return list(dict.fromkeys(needed)), list(dict.fromkeys(optional))


def check_no_random_layers(module: nn.Module, owner: str) -> None:
    """Raises if a module would stay random although its stochastic networks run their deterministic forward.

    Raises:
        ValueError: if there are dropout or flipout layers outside a :class:`StochasticMLP`, or sub-models that draw
            noise without one.
    """
    networks = [part for part in module.modules() if isinstance(part, StochasticMLP)]
    inside = {layer for network in networks for layer in network.modules()}
    kinds = (*_DROPOUTS, FlipoutLinear)
    random = [
        name or type(part).__name__
        for name, part in module.named_modules()
        if (isinstance(part, kinds) and part not in inside)
        or (isinstance(part, SubModel) and part.noise_names and part.module not in networks)
    ]
    if random:
        raise ValueError(
            f"{owner} needs a deterministic model; {type(module).__name__} has random parts ({random}). Put random "
            "layers into a StochasticMLP, whose mean network is then used, or take them out: the noise of this filter "
            "is in its covariances."
        )
