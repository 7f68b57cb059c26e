"""Update of the iterated ensemble Kalman smoother, which repeats transition, observation and analysis."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import cast

import torch
from tensordict import NestedKey, unravel_key
from tensordict.nn import TensorDictModuleBase
from torch import nn

from torch_denkf._checks import check_count, check_number
from torch_denkf.baselines.iterated_smoothing import iterated_smoothing
from torch_denkf.beliefs import moments_of
from torch_denkf.functional import analyse
from torch_denkf.functional.draws import exact_draws
from torch_denkf.functional.inflation import inflate
from torch_denkf.functional.manifolds import Space, check_space
from torch_denkf.modules.around import AugmentedBelief
from torch_denkf.modules.ensemble import Rotated
from torch_denkf.modules.gaussian import further_keys
from torch_denkf.modules.motion_noise import NoisyTransition
from torch_denkf.modules.spaces import mean_reading, narrowed_mask
from torch_denkf.running import check_module, random_parts, run_module
from torch_denkf.submodel import Call, Entries, Initial, flat_noise, role

__all__ = ["IteratedAnalysis", "with_smoothed"]

_SMOOTHED = ("ensemble", "mean", "var", "age")


def with_smoothed(initial: TensorDictModuleBase, *, belief_prefix: str = "belief") -> AugmentedBelief:
    """Returns an initial belief that is also the smoothed belief of the state before it.

    Args:
        initial: writes ``ensemble`` ``[*B, E, S]``, ``mean`` and ``var`` ``[*B, S]`` under ``belief_prefix``.
        belief_prefix: see there.

    Example:
        >>> from tensordict import TensorDict
        >>> from torch_denkf.modules import GaussianPrior
        >>> start = with_smoothed(GaussianPrior([0.0], [1.0], ensemble_size=4))
        >>> start(TensorDict({}))["smoothed", "age"]
        tensor([0])
    """
    keys: list[NestedKey] = [("smoothed", name) for name in _SMOOTHED]
    follow = partial(_twice, belief_prefix, tuple(keys), role(initial, Initial).space)
    return AugmentedBelief(initial, [], _nothing, follow_keys=keys, follow=follow)


def _nothing(belief: Entries, batch_size: torch.Size) -> list[torch.Tensor]:
    return []


def _twice(prefix: str, keys: Sequence[NestedKey], space: Space | None, belief: Entries) -> list[torch.Tensor]:
    if all(key in belief for key in keys):  # stored with it
        return [belief[key] for key in keys]
    ensemble, names = belief[prefix, "ensemble"], [(prefix, "mean"), (prefix, "var")]
    known = all(key in belief for key in names)
    moments = [belief[key] for key in names] if known else moments_of(ensemble, None, space)
    return [ensemble, *moments, torch.zeros_like(ensemble[..., 0, :1], dtype=torch.int64)]


class IteratedAnalysis(Rotated):
    r"""Corrects the previous state by the reading, and repeats the step from there.

    Gauss-Newton steps in the space of the members, each with a run of transition and observation; see
    :func:`~torch_denkf.baselines.iterated_smoothing.iterated_smoothing`. Gaussian process noise of each member is
    estimated, too (Sakov, Haussaire & Bocquet 2018).

    Args:
        transition: forecasts ``("forecast", "ensemble")`` from ``("belief", "ensemble")``; deterministic, or a
            :class:`NoisyTransition` around a deterministic one.
        observation: observes the forecast, writes ``("forecast", "observation")``; deterministic.
        iterations: number of Gauss-Newton iterations.
        inflation: factor on the anomalies of the smoothed members, in elements with an observation.
        rotate: applies a random mean-preserving rotation to the anomalies.
        space: space of the state; ``None`` for vectors. Members are corrected as tangents at their mean.
        reading_space: space of the reading; innovation and R are tangents.
        ensemble_key: members before the step, ``[*B, E, S]``.
        observation_key: learned observations ``[*B, E, O]``, whose mean is used, or one reading ``[*B, O]``.
        noise_variance_key: variances ``[*B, O]``.
        observed_key: optional mask ``[*B, 1]`` or ``[*B, O]``.
        belief_prefix: prefix of the outputs at the new time, ``ensemble``, ``mean`` and ``var``; those at the previous
            time are stored under ``"smoothed"``, with ``age`` ``[*B, 1]``, 1 step.
        info_prefix: prefix of ``innovation`` ``[*B, O]``, ``nis`` and ``log_likelihood`` ``[*B, 1]``, of the forecast
            before the update.

    Raises:
        ValueError: if transition or observation draw other noise.
        KeyError: if an entry is missing.
    """

    def __init__(
        self,
        transition: TensorDictModuleBase,
        observation: TensorDictModuleBase,
        *,
        iterations: int = 10,
        inflation: float = 1.0,
        rotate: bool = False,
        space: Space | None = None,
        reading_space: Space | None = None,
        ensemble_key: NestedKey = ("belief", "ensemble"),
        observation_key: NestedKey = ("sensor", "ensemble"),
        noise_variance_key: NestedKey = ("sensor", "noise"),
        observed_key: NestedKey = "observed",
        belief_prefix: str = "belief",
        info_prefix: str = "info",
    ):
        check_module("transition", transition)
        check_module("observation", observation)
        check_count("iterations", iterations)
        check_number("inflation", inflation, above=0)
        _check_same_noise(transition, observation)
        self_made = [ensemble_key, *map(unravel_key, transition.out_keys)]
        further, optional = further_keys([transition, observation], [*self_made, observation_key, noise_variance_key])
        out_keys = [(belief_prefix, name) for name in ("ensemble", "mean", "var")]
        out_keys += [("smoothed", name) for name in _SMOOTHED]
        out_keys += [(info_prefix, name) for name in ("innovation", "nis", "log_likelihood")]
        super().__init__(
            nn.ModuleDict({"transition": transition, "observation": observation}),
            [ensemble_key, observation_key, noise_variance_key, *further],
            out_keys,
            optional_keys=[observed_key, *optional],
        )
        self.iterations, self.inflation, self.rotate = iterations, inflation, rotate
        self.space, self.reading_space = check_space("space", space), check_space("reading_space", reading_space)
        self.info_prefix, self.observed_key = info_prefix, unravel_key(observed_key)
        self.reading_keys = self.in_keys[1:3]

    def parts(self):
        """Returns the transition, whose noise is estimated; the observation has none."""
        return {"transition": self.module["transition"]}

    def on_entries(self, entries, call):
        """Returns the belief, the smoothed belief, and the diagnostics."""
        ensemble, reading, variance = (self.required(entries, key) for key in self.in_keys[:3])
        space, on = self.space, self.reading_space
        observed = narrowed_mask(on, entries.get(self.observed_key))
        if reading.ndim == ensemble.ndim:
            reading = mean_reading(on, reading, observed)
        center = ensemble[..., :1, :] if space is None else space.mean(ensemble).unsqueeze(-2)
        start = ensemble if space is None else space.minus(ensemble, center)
        dim = start.shape[-1]
        noise = self._motion_noise(entries, start, call)
        whole = torch.cat([start, *noise.values()], -1)

        def states(members: torch.Tensor) -> torch.Tensor:
            return members[..., :dim] if space is None else space.plus(center, members[..., :dim])

        def forecast(members: torch.Tensor) -> Entries:
            work, begin = {**entries, unravel_key(self.in_keys[0]): states(members)}, dim
            for key, value in noise.items():
                work[key] = members[..., begin : begin + value.shape[-1]]
                begin += value.shape[-1]
            transition = self.module["transition"]
            return {**work, **run_module(transition, work, call.part("transition")._replace(raw=True))}

        def predict(members: torch.Tensor) -> torch.Tensor:
            observation = self.module["observation"]
            written = run_module(observation, forecast(members), call._replace(sample=False))
            predicted = written[unravel_key(observation.out_keys[0])]
            if on is None:
                return predicted
            about, read = on.align(predicted, reading, observed)
            return about - read.unsqueeze(-2)  # as seen from the reading: each iteration has tangents of its own

        due = reading if on is None else torch.zeros_like(variance)
        smoothed, predicted = iterated_smoothing(
            whole, predict, due, variance, observed=observed, iterations=self.iterations
        )
        diagnostics = analyse(predicted, predicted, due, variance, scheme="sakov", observed=observed)[1:]
        smoothed = self._after(smoothed, observed, self._noise(entries, [ensemble], call))
        moved = forecast(smoothed)[unravel_key(self.module["transition"].out_keys[0])]
        before = states(smoothed)
        age = torch.ones(*call.batch_size, 1, dtype=torch.int64, device=ensemble.device)
        out = (
            *(moved, *moments_of(moved, None, space)),
            *(before, *moments_of(before, None, space), age),
            *diagnostics,
        )
        return dict(zip(self.out_keys, out, strict=True))

    def _motion_noise(self, entries: Entries, ensemble: torch.Tensor, call: Call) -> Entries:
        """Returns the noise of the members' motion, drawn once for all iterations."""
        noise: Entries = {}
        if not call.sample:
            return noise
        for place, part in random_parts(self.module["transition"], call.part("transition").place):
            drawn = part._noise(entries, [ensemble], call._replace(place=place))
            if cast(NoisyTransition, part).exact:  # here, as what is found afterwards has a mean and a covariance
                drawn = exact_draws(cast(torch.Tensor, drawn), ensemble, *noise.values())
            noise.update(flat_noise(drawn, place))
        return noise

    def _after(self, smoothed, observed, rotation) -> torch.Tensor:
        """Returns the smoothed members, inflated and rotated in elements with an observation."""
        changed = self.rotated(inflate(smoothed, self.inflation) if self.inflation != 1.0 else smoothed, rotation)
        return changed if observed is None else torch.where(observed.any(-1)[..., None, None], changed, smoothed)


def _check_same_noise(transition: TensorDictModuleBase, observation: TensorDictModuleBase) -> None:
    parts: Sequence = [*random_parts(transition, "transition"), *random_parts(observation, "observation")]
    other = [f"{place} ({type(part).__name__})" for place, part in parts if not isinstance(part, NoisyTransition)]
    if other or any(place.startswith("observation") for place, _ in parts):
        raise ValueError(
            f"The iterated smoother repeats a step from other states, and needs to know what its noise does; {other} "
            "draw noise of their own. Take a deterministic network (layer='none'), and process_noise for the motion's."
        )
