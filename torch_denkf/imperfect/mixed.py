"""Base of updates whose posterior is a mixture of two beliefs."""

from __future__ import annotations

from typing import cast

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor, nn

from torch_denkf.beliefs import Ensemble, complete
from torch_denkf.functional.manifolds import Space, is_flat
from torch_denkf.imperfect.mixture import mix_members, mix_moments
from torch_denkf.modules.around import Around
from torch_denkf.modules.kalman import KalmanAnalysis
from torch_denkf.running import random_parts
from torch_denkf.smoothers.past import LaggedAnalysis
from torch_denkf.submodel import Call, Entries, SubModel, Update, flat_noise

__all__ = ["MixedUpdate", "kind_of_update", "wider_forecast", "wider_past", "with_draws", "with_noise_from"]


class MixedUpdate(Around):
    """Wraps an update, and replaces a mixture of two beliefs by one belief with its mean and covariance.

    Attributes:
        kind: of the belief, see :func:`kind_of_update`.
    """

    kind: str

    def mixed(
        self, entries: Entries, probability: Tensor, share: Tensor, out: Entries, other: Entries, seen: Tensor | None
    ) -> Entries:
        """Returns the belief of the mixture.

        Args:
            entries: with the forecast.
            probability: prior probability of the first, ``[*B, 1]``. With 1 the result is exactly the first belief, and
                with 0 the second.
            share: posterior probability of the first.
            out: the outputs of the update, the first belief.
            other: the second, under the keys of ``out``.
            seen: mask of elements with an observation, ``[*B, 1]``; the others get the first belief. ``None`` for all.
        """
        first = probability >= 1 if seen is None else (probability >= 1) | ~seen
        mix = self._mixed_moments if self.kind == "moments" else self._mixed_members
        mixed = mix(entries, probability <= 0, share, out, other)
        return {key: torch.where(_like(first, value), out[key], value) for key, value in mixed.items()}

    def _mixed_moments(self, entries: Entries, never: Tensor, share: Tensor, out: Entries, other: Entries) -> Entries:
        """Returns mean, covariance and variances; on a space in the tangents at the forecast's mean."""
        space, start, keys = self.space, entries[self.module.in_keys[0]], self.module.out_keys[:3]
        if space is None:
            mean, cov = mix_moments(share, out[keys[0]], out[keys[1]], other[keys[0]], other[keys[1]])
        else:
            parts: list[Tensor] = []
            for belief in (out, other):
                step, cov = space.minus(belief[keys[0]], start), belief[keys[1]]
                if not is_flat(space):
                    back = torch.linalg.inv(space.right_jacobian(step))
                    cov = back @ cov @ back.mT
                parts += [step, cov]
            step, cov = mix_moments(share, *parts)
            mean = space.plus(start, step)
            if not is_flat(space):
                turn = space.right_jacobian(step)
                cov = turn @ cov @ turn.mT
                cov = (cov + cov.mT) / 2
        mixed = {keys[0]: mean, keys[1]: cov}
        mixed = {key: torch.where(_like(never, value), other[key], value) for key, value in mixed.items()}
        return {**mixed, keys[2]: mixed[keys[1]].diagonal(dim1=-2, dim2=-1)}

    def _mixed_members(self, entries: Entries, never: Tensor, share: Tensor, out: Entries, other: Entries) -> Entries:
        """Returns ensemble, mean and variances; a lag window, and a covariance, where the analysis writes them."""
        analysis, space, batch = self.module, self.space, len(share.shape) - 1
        pairs = [(analysis.in_keys[0], analysis.out_keys[0])]
        pairs += [(key, key) for key in analysis.in_keys if key in analysis.out_keys]  # lag window, in place
        first, second = ([belief[key] for _, key in pairs] for belief in (out, other))
        if space is not None:
            centers = [_center(space, entries[key], batch) for key, _ in pairs]
            first, second = (list(map(space.minus, members, centers)) for members in (first, second))
        flat = [[part.flatten(batch + 1) for part in parts] for parts in (first, second)]
        both = mix_members(share, torch.cat(flat[0], -1), torch.cat(flat[1], -1))
        parts = [
            part.reshape(like.shape)
            for part, like in zip(both.split([part.shape[-1] for part in flat[0]], -1), first, strict=True)
        ]
        if space is not None:
            parts = list(map(space.plus, centers, parts))
        mixed = {
            key: torch.where(_like(never, value), other[key], value)
            for (_, key), value in zip(pairs, parts, strict=True)
        }
        kind = Ensemble(pairs[0][1][:-1], space)
        return complete(mixed, [key for key in analysis.out_keys if key[:-1] == kind.prefix], [kind])


def kind_of_update(analysis: Update, name: str) -> str:
    """Returns the kind of belief that an analysis updates: ``"members"``, ``"moments"`` or ``"particles"``.

    Raises:
        TypeError: if the keys of the forecast and the reading of the analysis are unknown; ``name`` is the wrapper's.
    """
    wrapped = isinstance(analysis, Around) and not analysis.updates_ensemble
    if isinstance(analysis, Update) and not wrapped and analysis.info_prefix is not None:
        written = [cast("tuple[str, ...]", unravel_key(key)) for key in analysis.out_keys]
        scores = {(analysis.info_prefix, name) for name in ("nis", "innovation", "log_likelihood")}
        read = [key[-1] for key in map(unravel_key, analysis.in_keys[:2])]
        if scores <= set(written):
            if "log_weight" in (key[-1] for key in written):
                return "particles"
            if read == ["mean", "cov"] and [key[-1] for key in written[:3]] == ["mean", "cov", "var"]:
                return "moments"
            if analysis.updates_ensemble:
                return "members"
    raise TypeError(
        f"{type(analysis).__name__} does not say where its forecast and its reading are. {name} goes around an "
        "EnsembleAnalysis, LocalEnsembleAnalysis, KalmanAnalysis, EKFAnalysis or UKFAnalysis, around ParticleAnalysis "
        "with a GaussianLikelihood, or around one of your own that updates an ensemble and writes innovation, nis and "
        "log_likelihood under its info_prefix."
    )


def wider_forecast(analysis: Update, entries: Entries, factor: Tensor, *, members: bool) -> Entries:
    """Returns the entries with the forecast's covariance times a factor ``[*B, 1]``.

    Args:
        analysis: whose forecast it is.
        entries: of an ensemble as :meth:`Update.aligned` gives them.
        factor: on variances; bit-equal for 1.
        members: whether it updates an ensemble, and not a mean and a covariance.
    """
    if not members:
        key = analysis.in_keys[1]
        return {**entries, key: entries[key] * factor.unsqueeze(-1)}
    keys = analysis.in_keys[:2]  # states, and what is predicted of them, in plain numbers
    spaces = (analysis.space, None)
    wider = {key: spread_about_mean(entries[key], factor.sqrt(), on) for key, on in zip(keys, spaces, strict=True)}
    return {**entries, **wider}


def wider_past(analysis: Update, entries: Entries, factor: Tensor) -> Entries:
    """Returns the entries with the lag window of a :class:`LaggedAnalysis` spread likewise."""
    if not isinstance(analysis, LaggedAnalysis):
        return entries
    key, space = analysis.in_keys[-1], analysis.space
    past = entries[key]
    if space is not None:
        of_times = spread_about_mean(past.movedim(-2, -3), factor.sqrt().unsqueeze(-2), space)
        return {**entries, key: of_times.movedim(-3, -2)}
    wider = spread_about_mean(past.flatten(-2), factor.sqrt())
    return {**entries, key: wider.unflatten(-1, past.shape[-2:])}


def spread_about_mean(members: Tensor, factor: Tensor, space: Space | None = None) -> Tensor:
    """Returns members ``[*B, E, N]``, their distances from the mean times ``factor`` ``[*B, 1]``; bit-equal for 1."""
    factor = factor.unsqueeze(-2)
    if space is not None:
        center = space.mean(members).unsqueeze(-2)
        return torch.where(factor == 1, members, space.plus(center, factor * space.minus(members, center)))
    mean = members.mean(-2, keepdim=True)
    return torch.where(factor == 1, members, mean + factor * (members - mean))


def with_draws(module: nn.Module, entries: Entries, call: Call) -> Entries:
    """Returns the entries with the random numbers of a module, so that two runs of it share them."""
    entries = dict(entries)
    for place, part in random_parts(module, call.place) if call.sample else ():
        values = [part.required(entries, key) for key in part.in_keys]
        noise = SubModel._noise(part, entries, values, call._replace(place=place))  # as drawn: used twice
        entries.update(flat_noise(noise, place))
    return entries


def with_noise_from(key: NestedKey, analysis: KalmanAnalysis) -> KalmanAnalysis:
    """Returns a Kalman analysis that shares the matrix of another, and reads the noise that the other holds."""
    keys = analysis.in_keys
    changed = KalmanAnalysis(
        analysis.matrix.detach(),
        None,
        inflation=analysis.inflation,
        reading_space=analysis.reading_space,
        observation_key=keys[2],
        noise_variance_key=key,
        observed_key=analysis.observed_key,
        forecast_prefix=keys[0][0],
        belief_prefix=analysis.out_keys[0][0],
        info_prefix=analysis.info_prefix,
    )
    if isinstance(analysis.matrix, nn.Parameter):
        del changed.matrix
    changed.matrix = analysis.matrix
    return changed


def _like(mask: Tensor, value: Tensor) -> Tensor:
    """Returns a mask ``[*B, 1]`` with as many dimensions as a value ``[*B, ...]``."""
    return mask.reshape(*mask.shape[:-1], *(1,) * (value.ndim - mask.ndim + 1))


def _center(space: Space, members: Tensor, batch: int) -> Tensor:
    """Returns a point ``[*B, 1, P]`` near members ``[*B, E, P]``, or one per time of a lag window ``[*B, E, L, P]``."""
    if members.ndim == batch + 2:
        return space.near(members).unsqueeze(-2)
    return space.near(members.movedim(-3, -2)).unsqueeze(-3)
