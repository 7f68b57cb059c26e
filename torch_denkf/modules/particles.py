r"""Weighted particles: initial weights, resampling, and update.

Weights are normalised log-weights ``[*B, E]`` next to the ensemble. The order of a step is

    resample -- move -- observe -- weight

so that the belief after the update has all particles, with their weights. Resampling would only add noise to it, and
belongs to the next step, which needs equal weights (as in Jonschkowski et al. 2018). A loss of the belief then reaches
the likelihood even if no gradient flows through resampling.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Literal

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_choice, check_count, check_number
from torch_denkf.beliefs import moments_of
from torch_denkf.functional import soft_resample, systematic_resample, transport_resample
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.functional.resampling import effective_sample_size, jitter_copies
from torch_denkf.functional.weighted import weighted_innovation
from torch_denkf.modules.around import AugmentedBelief
from torch_denkf.modules.likelihood import GaussianLikelihood
from torch_denkf.modules.spaces import narrowed_mask
from torch_denkf.running import check_module, reads, run_module
from torch_denkf.submodel import Entries, Transition, Update

__all__ = ["ParticleAnalysis", "ResampledTransition", "with_weights"]


def with_weights(
    initial: TensorDictModuleBase,
    *,
    ensemble_key: NestedKey = ("belief", "ensemble"),
    log_weight_key: NestedKey = ("belief", "log_weight"),
) -> AugmentedBelief:
    """Returns an initial belief whose members are particles of equal weight.

    Args:
        initial: writes an ensemble ``[*B, E, S]``, see :mod:`torch_denkf.modules.belief`.
        ensemble_key: output of ``initial``.
        log_weight_key: the log-weights, −log E, ``[*B, E]``.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior
        >>> start = with_weights(GaussianPrior([0.0], [1.0], ensemble_size=4))
        >>> start(TensorDict({}, []))["belief", "log_weight"].exp()
        tensor([0.2500, 0.2500, 0.2500, 0.2500])
    """
    return AugmentedBelief(initial, [log_weight_key], partial(_equal_weights, unravel_key(ensemble_key)), nested=True)


def _equal_weights(ensemble_key: NestedKey, belief: Entries, _: torch.Size) -> list[torch.Tensor]:
    ensemble = belief[ensemble_key]
    return [torch.full_like(ensemble[..., 0], -math.log(ensemble.shape[-2]))]


class ResampledTransition(Transition):
    r"""Resamples the particles of the belief, then moves them.

    Only observed frames change weights, so particles are resampled only before observed frames; over missing frames
    particles and weights are unchanged.

    A particle that diverges (so far that its cube overflows) loses its weight to the others, and is moved to the
    heaviest one. ``"transport"`` averages particles, so that a diverging particle with weight displaces the others.

    Args:
        transition: forecasts an ensemble, ``("belief", "ensemble")`` to ``("forecast", "ensemble")``; its keys are
            kept.
        scheme: ``"systematic"`` (hard, no gradient), ``"soft"`` (hard, but the weights keep a gradient),
            ``"transport"`` (optimal transport, differentiable, biased) or ``None`` for no resampling; see
            :mod:`torch_denkf.functional.resampling` and :func:`~torch_denkf.functional.transport_resample`.
        alpha: share of the uniform distribution in soft resampling.
        epsilon: regularisation of transport.
        iterations: number of Sinkhorn's iterations in transport.
        ess_threshold: resamples only if the effective number of particles is below this share of E. ``None``: always.
        jitter: separates copies by a Gaussian kernel of this many times the usual width; 0 for none. For
            ``"systematic"`` and ``"soft"``; see ``jitter_copies`` in ``functional/resampling.py``.
        log_weight_key: log-weights of the belief ``[*B, E]``.
        out_log_weight_key: log-weights of the forecast ``[*B, E]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]`` of the frame after the transition.
        past_key: earlier states of the particles, ``[*B, E, L, S]``, the latest first, which are picked with them; the
            present state becomes the latest. ``None`` for none. Not for ``"transport"``, which picks no particle.
        out_past_key: the new lag window ``[*B, E, L, S]``.

    Raises:
        ValueError: on an unknown ``scheme``, a ``jitter`` or ``past_key`` that it cannot use, or numbers out of range.
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import LearnedTransition
        >>> step = ResampledTransition(LearnedTransition(nn.Linear(1, 1)), "systematic")
        >>> td = TensorDict({"belief": {"ensemble": torch.randn(8, 1), "log_weight": torch.randn(8).log_softmax(-1)}})
        >>> step(td)["forecast", "log_weight"].exp().unique()
        tensor([0.1250])
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        scheme: Literal["systematic", "soft", "transport"] | None = "systematic",
        *,
        alpha: float = 0.05,
        epsilon: float = 0.05,
        iterations: int = 20,
        ess_threshold: float | None = None,
        jitter: float = 0.0,
        log_weight_key: NestedKey = ("belief", "log_weight"),
        out_log_weight_key: NestedKey = ("forecast", "log_weight"),
        observed_key: NestedKey = "observed",
        past_key: NestedKey | None = None,
        out_past_key: NestedKey = ("forecast", "past"),
    ):
        check_module("transition", transition)
        check_choice("scheme", scheme, ("systematic", "soft", "transport", None))
        check_number("alpha", alpha, least=0, most=1)
        check_number("epsilon", epsilon, above=0)
        check_count("iterations", iterations)
        if ess_threshold is not None:
            check_number("ess_threshold", ess_threshold, least=0, most=1, cure="It is a share of E")
        check_number("jitter", jitter, least=0)
        if jitter and scheme not in ("systematic", "soft"):
            raise ValueError(
                f'jitter is for the copies of "systematic" and "soft" resampling, 0 or more; got {jitter} '
                f"with {scheme!r}."
            )
        if past_key is not None and scheme == "transport":
            raise ValueError('"transport" picks no particles, so that they have no past; leave past_key out.')
        (ensemble_key, *others), optional = reads(transition)
        others = [key for key in others if key != unravel_key(log_weight_key)]
        past = [] if past_key is None else [past_key]
        super().__init__(
            transition,
            [ensemble_key, log_weight_key, *past, *others],
            [transition.out_keys[0], out_log_weight_key, *transition.out_keys[1:], *([out_past_key] if past else [])],
            optional_keys=[observed_key, *optional],
        )
        self.jitter, self.has_past = jitter, bool(past)
        self.scheme, self.alpha, self.ess_threshold = scheme, alpha, ess_threshold
        self.mask_key = unravel_key(observed_key)
        self.epsilon, self.iterations = epsilon, iterations

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names the uniform number of schemes that need it, and normal numbers for a jitter."""
        if self.scheme not in ("systematic", "soft"):
            return ()
        return ("uniform", "normal") if self.jitter else ("",)

    def draw_noise(self, batch_size, *, members=None, state_dim=None, device=None, dtype=None, generator=None, **_):
        """Draws uniform numbers ``[*batch_size, 1]``, and for a jitter normal numbers ``[*batch_size, E, S]``."""
        if not self.noise_names:
            return None
        uniform = torch.rand((*batch_size, 1), device=device, dtype=dtype, generator=generator)
        if not self.jitter:
            return uniform
        if members is None or state_dim is None:
            return None
        shape = (*batch_size, members, state_dim)
        return {"uniform": uniform, "normal": torch.randn(shape, device=device, dtype=dtype, generator=generator)}

    def noise_sizes(self, particles, *_):
        """Returns E and S, from the particles."""
        return {"members": particles.shape[-2], "state_dim": particles.shape[-1]}

    def parts(self):
        """Returns the transition."""
        return {"transition": self.module}

    def on_entries(self, entries, call):
        """Returns the forecast ensemble and its weights."""
        (key, weight_key), out_weight_key = map(unravel_key, self.in_keys[:2]), unravel_key(self.out_keys[1])
        particles, log_weights = self.required(entries, key), self.required(entries, weight_key)
        past = self.required(entries, unravel_key(self.in_keys[2])) if self.has_past else None
        wanted = self._wanted(log_weights, entries.get(self.mask_key))
        noise = self._noise(entries, [particles, log_weights], call)
        if past is not None:  # particles and their pasts are picked together
            past = torch.cat([particles.unsqueeze(-2), past[..., :-1, :]], -2)
        moved, weights, picked = self._resample(particles, log_weights, past, noise)
        if wanted is not None:
            moved = torch.where(wanted.unsqueeze(-1), moved, particles)
            weights = torch.where(wanted, weights, log_weights)
            picked = None if past is None else torch.where(wanted[..., None, None], picked, past)
        written = run_module(self.module, {**entries, key: moved, weight_key: weights}, call.part("transition"))
        out_key = unravel_key(self.out_keys[0])
        forecast, weights = _without_lost(written[out_key], weights)
        written = {**written, out_key: forecast, out_weight_key: weights}
        return written if past is None else {**written, unravel_key(self.out_keys[-1]): picked}

    def with_past(self, past_key: NestedKey, out_past_key: NestedKey) -> ResampledTransition:
        """Returns the transition for particles with a lag window; the motion is shared, not copied."""
        options = ("alpha", "epsilon", "iterations", "ess_threshold", "jitter")
        return ResampledTransition(
            self.module,
            self.scheme,
            **{name: getattr(self, name) for name in options},
            log_weight_key=self.in_keys[1],
            out_log_weight_key=self.out_keys[1],
            observed_key=self.mask_key,
            past_key=past_key,
            out_past_key=out_past_key,
        )

    def _wanted(self, log_weights: torch.Tensor, observed: torch.Tensor | None) -> torch.Tensor | None:
        """Marks the rows to resample, ``[*B, 1]``; ``None`` for all."""
        wanted = None if observed is None else observed.any(-1, keepdim=True)
        if self.ess_threshold is not None:
            few = effective_sample_size(log_weights) < self.ess_threshold * log_weights.shape[-1]
            wanted = few.unsqueeze(-1) if wanted is None else wanted & few.unsqueeze(-1)
        return wanted

    def _resample(self, particles, log_weights, past, noise):
        """Returns the particles, their weights, and the picked past."""
        if self.scheme is None:
            return particles, log_weights, past
        if self.scheme == "transport":
            return *transport_resample(particles, log_weights, epsilon=self.epsilon, iterations=self.iterations), None
        if noise is None:
            raise ValueError(f'resampling "{self.scheme}" has no deterministic forward; use "transport" or None.')
        uniform = noise["uniform"] if self.jitter else noise
        whole = particles if past is None else past.flatten(-2)
        if self.scheme == "systematic":
            picked, weights = systematic_resample(whole, log_weights, uniform)
        else:
            picked, weights = soft_resample(whole, log_weights, uniform, self.alpha)
        if past is not None:
            past = picked.unflatten(-1, past.shape[-2:])
            picked = past[..., 0, :]
        if self.jitter:
            picked = jitter_copies(picked, particles, log_weights, noise["normal"], factor=self.jitter)
        return picked, weights, past


def _without_lost(forecast: torch.Tensor, log_weights: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Replaces particles that have diverged by the heaviest one, and sets their weights to zero.

    A particle has diverged if its cube would overflow: beyond 7e12 in float32, 6e102 in float64. An infinite particle
    of zero weight would still make NaN in each sum, in the next step, and in every gradient. If all particles diverged,
    the motion has failed, and they are unchanged, for the filter's checks to report.
    """
    lost = ~(forecast.detach().abs() <= torch.finfo(forecast.dtype).max ** (1 / 3)).all(-1)
    lost = lost & ~lost.all(-1, keepdim=True)
    left = torch.where(lost, -math.inf, log_weights)
    heaviest = left.argmax(-1, keepdim=True).unsqueeze(-1).expand_as(forecast[..., :1, :])
    forecast = torch.where(lost.unsqueeze(-1), forecast.gather(-2, heaviest), forecast)
    return forecast, torch.where(lost.any(-1, keepdim=True), left.log_softmax(-1), log_weights)


class ParticleAnalysis(Update):
    r"""Bayes' rule on particles: :math:`w^i \propto w^i_{t|t-1}\, p(y_t | x^i)`; the particles do not move.

    Mean and variance are weighted, over all particles, before any resampling, which would only add to their errors.
    If nothing is observed the weights are exactly unchanged; so are they if no particle can explain the reading, whose
    log-likelihood is then minus infinity.

    Args:
        likelihood: a Gaussian likelihood, to also write the innovation of its reading and its normalised square;
            ``None`` for neither.
        tempering: power of the likelihood; below one the belief stays wider, as with an inflated ensemble.
        space: space of the state; ``None`` for plain numbers.
        forecast_key: particles ``[*B, E, S]``.
        log_weight_key: their normalised log-weights ``[*B, E]``, see :class:`ResampledTransition`.
        log_likelihood_key: :math:`\log p(y | x^i)`, ``[*B, E]``, see :mod:`torch_denkf.modules.likelihood`.
        belief_prefix: prefix of the outputs: ``ensemble`` ``[*B, E, S]``, ``log_weight`` ``[*B, E]``, ``mean`` and
            ``var`` ``[*B, S]``.
        info_prefix: prefix of the diagnostics: the effective number of particles ``ess`` ``[*B, 1]``, after the update,
            and ``log_likelihood`` ``[*B, 1]``, :math:`\log \sum_i w^i_{t|t-1}\, p(y_t | x^i)`; with a ``likelihood``
            also ``innovation`` ``[*B, O]`` and ``nis`` ``[*B, 1]``, see
            :func:`~torch_denkf.functional.weighted.weighted_innovation`.

    Raises:
        KeyError: if an entry is missing.

    Example:
        >>> from tensordict import TensorDict
        >>> td = TensorDict({"forecast": {
        ...     "ensemble": torch.tensor([[0.0], [1.0]]),
        ...     "log_weight": torch.tensor([0.5, 0.5]).log(),
        ...     "log_likelihood": torch.tensor([0.1, 0.3]).log(),
        ... }})
        >>> ParticleAnalysis()(td)["belief", "mean"]
        tensor([0.7500])
    """

    def __init__(
        self,
        likelihood: GaussianLikelihood | None = None,
        *,
        tempering: float = 1.0,
        space: Space | None = None,
        forecast_key: NestedKey = ("forecast", "ensemble"),
        log_weight_key: NestedKey = ("forecast", "log_weight"),
        log_likelihood_key: NestedKey = ("forecast", "log_likelihood"),
        belief_prefix: str = "belief",
        info_prefix: str = "info",
    ):
        of_reading = [] if likelihood is None else likelihood.in_keys
        diagnostics = ["ess", "log_likelihood", *["innovation", "nis"] * bool(of_reading)]
        super().__init__(
            nn.Identity(),
            [forecast_key, log_weight_key, log_likelihood_key, *of_reading],
            [(belief_prefix, name) for name in ("ensemble", "log_weight", "mean", "var")]
            + [(info_prefix, name) for name in diagnostics],
            optional_keys=[] if likelihood is None else likelihood.optional_keys,
        )
        check_number("tempering", tempering, above=0)
        self.tempering, self.info_prefix, self.space = tempering, info_prefix, check_space("space", space)
        self.reading_space = None if likelihood is None else likelihood.reading_space
        if likelihood is not None:
            self.reading_keys, self.predicted_key = likelihood.reading_keys, likelihood.predicted_key
            self.observed_key = likelihood.observed_key

    def compute(self, particles, prior, log_likelihood, *of_reading):
        """Returns the belief and the diagnostics."""
        joint = prior + self.tempering * log_likelihood
        total = torch.logsumexp(joint, -1, keepdim=True)
        # Without observations the likelihood is one: without this, rounding would change the weights. If no particle
        # can explain the reading, in this precision, Bayes' rule is 0 / 0, and the log-likelihood is -inf.
        seen = (log_likelihood != 0).any(-1, keepdim=True) & (total != -math.inf)
        log_weights = torch.where(seen, joint - total, prior)
        return (
            particles,
            log_weights,
            *moments_of(particles, log_weights, self.space),
            effective_sample_size(log_weights).unsqueeze(-1),
            torch.where(seen | (total == -math.inf), total, torch.zeros_like(total)),
            *(self._innovation(prior, *of_reading) if of_reading else ()),
        )

    def _innovation(self, prior, predicted, reading, variance, observed=None) -> tuple[torch.Tensor, torch.Tensor]:
        if self.reading_space is not None:
            observed = narrowed_mask(self.reading_space, observed)
            predicted, reading = self.reading_space.align(predicted, reading, observed)
        if reading.ndim == predicted.ndim:
            reading = reading.mean(-2)
        return weighted_innovation(predicted, prior, reading, variance, observed=observed)[:2]
