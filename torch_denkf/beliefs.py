"""Kinds of belief: their carried entries, the entries computed from these, and limits on their variances.

A kind is a sub-class of :class:`Belief`, which is found by the names of its carried entries::

    class Mixture(Belief):
        carried = ("means", "covs", "log_weights")

        def derived(self, name, *carried):
            means, covs, log_weights = carried
            ...
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from math import sqrt
from typing import ClassVar

import torch
from tensordict import NestedKey
from torch import Tensor

from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.moments import ensemble_cov, ensemble_mean, ensemble_var
from torch_denkf.functional.weighted import weighted_mean, weighted_median, weighted_var

__all__ = [
    "Belief",
    "Ensemble",
    "Moments",
    "Particles",
    "complete",
    "is_samples",
    "is_summary",
    "kinds_of",
    "moments_of",
    "summary_keys",
]

#: The mean is clamped to this many standard deviations at the variance ceiling.
_FARTHEST = 1000.0
_SUMMARIES = ("mean", "var")


def moments_of(
    ensemble: Tensor, log_weights: Tensor | None = None, space: Space | None = None
) -> tuple[Tensor, Tensor]:
    """Returns mean and variances of members ``[*B, E, S]``; on a space the variances are of tangents at the mean."""
    if space is not None:
        mean = space.mean(ensemble, None if log_weights is None else log_weights.exp())
        away = space.minus(ensemble, mean.unsqueeze(-2))
        return mean, ensemble_var(away) if log_weights is None else weighted_var(away, log_weights)
    if log_weights is not None:
        return weighted_mean(ensemble, log_weights), weighted_var(ensemble, log_weights)
    mean = ensemble_mean(ensemble)
    return mean, ensemble_var(ensemble, mean)


class Belief:
    """A belief whose entries are stored under one prefix; the base class stands for an unknown kind.

    Args:
        prefix: first part of its keys, ``("belief",)`` for example.
        space: space of the state; ``None`` for plain numbers.

    Attributes:
        carried: names of the entries that continue from step to step; the first contains points of the state's space.
        carry: keys of these entries.

    Example:
        >>> kind, = kinds_of([("belief", "mean"), ("belief", "cov"), ("belief", "var")])
        >>> type(kind).__name__, kind.key("mean")
        ('Moments', ('belief', 'mean'))
        >>> kind.derived("var", torch.zeros(2), torch.diag(torch.tensor([1.0, 4.0])))
        tensor([1., 4.])
    """

    carried: ClassVar[tuple[str, ...]] = ()
    _kinds: ClassVar[list[type[Belief]]] = []

    def __init_subclass__(cls, **kwargs):
        super().__init_subclass__(**kwargs)
        Belief._kinds = sorted([cls, *Belief._kinds], key=lambda kind: -len(kind.carried))

    def __init__(self, prefix: tuple[str, ...] = ("belief",), space: Space | None = None):
        self.prefix, self.space = prefix, space
        self.carry: list[NestedKey] = [(*prefix, name) for name in self.carried]

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.prefix}, {self.space})"

    def key(self, name: str) -> NestedKey:
        """Returns the key of an entry."""
        return (*self.prefix, name)

    def derived(self, name: str, *carried: Tensor) -> Tensor | None:
        """Computes an entry that is not carried, ``"mean"`` or ``"var"``; ``None`` if it cannot be computed."""
        return None

    def finite(self, name: str, value: Tensor) -> Tensor:
        """Tells whether a carried entry is finite, as a boolean tensor ``[]``."""
        return value.isfinite().all()

    def flaws(self, entries: Mapping[NestedKey, Tensor]) -> list[str]:
        """Names the defects of a belief whose values are finite."""
        return []

    def limited(self, held: Mapping[str, Tensor], ceiling: float) -> dict[str, Tensor]:
        """Clamps variances to a ceiling, and the mean to a range around zero; correlations are kept.

        Args:
            held: the belief's entries by name, including ``"mean"`` and ``"var"``.
            ceiling: largest variance, in the state's units squared.

        Returns:
            The changed entries.
        """
        out = {"mean": self._within_reach(held["mean"], ceiling), "var": held["var"].clamp(max=ceiling)}
        if "cov" in held:
            factor = self._factor(held, ceiling)
            out["cov"] = held["cov"] * factor.unsqueeze(-1) * factor.unsqueeze(-2)
        return out

    def _factor(self, held: Mapping[str, Tensor], ceiling: float) -> Tensor:
        return (held["var"].detach() / ceiling).clamp(min=1).rsqrt()  # no gradient through the factor

    def _within_reach(self, mean: Tensor, ceiling: float) -> Tensor:
        farthest = _FARTHEST * sqrt(ceiling)
        return mean.clamp(-farthest, farthest) if self.space is None else mean


class Moments(Belief):
    """A Gaussian: mean ``[*B, S]`` and covariance ``[*B, S, S]``."""

    carried = ("mean", "cov")

    def derived(self, name, *carried):
        """Computes the variances."""
        _, cov = carried
        return cov.diagonal(dim1=-2, dim2=-1) if name == "var" else None

    def flaws(self, entries):
        """Names a covariance whose variances are negative."""
        key = self.key("cov")
        cov = entries.get(key)
        negative = cov is not None and bool((cov.diagonal(dim1=-2, dim2=-1) < 0).any())
        return [f"negative variances in {[key]}"] if negative else []


class Ensemble(Belief):
    """Members of equal weight, ``[*B, E, S]``."""

    carried = ("ensemble",)

    def derived(self, name, *carried):
        """Computes mean, variances and covariance of the sample."""
        (ensemble,) = carried
        if self.space is not None:
            mean = self.space.mean(ensemble).unsqueeze(-2)
            ensemble = mean if name == "mean" else self.space.minus(ensemble, mean)
        sample = {"mean": ensemble_mean, "var": ensemble_var, "cov": ensemble_cov}.get(name)
        return None if sample is None else sample(ensemble)

    def limited(self, held, ceiling):
        """Scales and shifts the members to the clamped moments; rows within the ceiling keep their exact values."""
        out, ensemble, mean = super().limited(held, ceiling), held["ensemble"], held["mean"].unsqueeze(-2)
        factor, now = self._factor(held, ceiling).unsqueeze(-2), out["mean"].unsqueeze(-2)
        if self.space is None:  # exact for a factor of one
            return {**out, "ensemble": torch.lerp(now, ensemble - (mean - now), factor)}
        moved = self.space.plus(mean, self.space.minus(ensemble, mean) * factor)
        return {**out, "ensemble": torch.where((factor == 1).all(-1, keepdim=True), ensemble, moved)}


class Particles(Belief):
    """Weighted particles: points ``[*B, E, S]`` and log-weights ``[*B, E]``; ``-inf`` is a weight of zero."""

    carried = ("ensemble", "log_weight")

    def derived(self, name, *carried):
        """Computes the weighted mean and variances."""
        ensemble, log_weight = carried
        return dict(zip(_SUMMARIES, moments_of(ensemble, log_weight, self.space), strict=True)).get(name)

    def finite(self, name, value):
        """Tells whether points and weights are finite; a weight may be zero."""
        return (value < torch.inf).all() if name == "log_weight" else super().finite(name, value)

    def limited(self, held, ceiling):
        """Moves only the particles that make the variance too large, to the weighted median plus or minus the limit.

        The others keep what is known, for the next observation. On a space no particle is moved.
        """
        out = {"var": held["var"].clamp(max=ceiling)}
        if self.space is not None:
            return out
        points, weights, exceeded = held["ensemble"], held["log_weight"], held["var"] > ceiling
        centre = self._within_reach(weighted_median(points, weights), ceiling).unsqueeze(-2)
        near = points.clamp(centre - sqrt(ceiling), centre + sqrt(ceiling))
        points = torch.where(exceeded.unsqueeze(-2), near, points)
        mean = torch.where(exceeded, weighted_mean(points, weights), held["mean"])
        return {**out, "mean": mean, "ensemble": points}


def kinds_of(
    keys: Iterable[NestedKey], space: Space | None = None, carry: Collection[NestedKey] = ()
) -> tuple[Belief, ...]:
    """Returns the kinds of the beliefs to which keys belong, one for each prefix.

    Args:
        keys: keys of entries of beliefs.
        space: space of the state; ``None`` for plain numbers.
        carry: keys that continue from step to step; if a prefix has any, they alone determine its kind.
    """
    groups: dict[tuple[str, ...], list[NestedKey]] = {}
    for key in keys:
        if not isinstance(key, str):
            groups.setdefault(key[:-1], []).append(key)
    found = []
    for prefix, group in groups.items():
        names = {key[-1] for key in [key for key in group if key in carry] or group}
        kind = next((kind for kind in Belief._kinds if names.issuperset(kind.carried)), Belief)
        found.append(kind(prefix, space))
    return tuple(found)


def is_summary(key: NestedKey) -> bool:
    """Tells whether the size of a belief's entry is independent of the number of members: mean, variances, an age."""
    return not isinstance(key, str) and key[-1] in (*_SUMMARIES, "age")


def is_samples(key: NestedKey) -> bool:
    """Tells by its name whether an entry contains samples, such as ``("sensor", "ensemble")``."""
    return not isinstance(key, str) and key[-1] in Ensemble.carried


def summary_keys(carry: Collection[NestedKey], written: Iterable[NestedKey]) -> list[NestedKey]:
    """Returns the moments among ``written`` keys that have the same prefix as a carried entry."""
    prefixes = {key[:-1] for key in carry if not isinstance(key, str)}
    moments = (*_SUMMARIES, "cov")
    return [key for key in written if not isinstance(key, str) and key[:-1] in prefixes and key[-1] in moments]


def complete(
    entries: dict[NestedKey, Tensor],
    belief: Iterable[NestedKey],
    kinds: Iterable[Belief],
    stored: Mapping[NestedKey, Tensor] | None = None,
) -> dict[NestedKey, Tensor]:
    """Adds the missing entries of the belief that can be computed from the carried ones.

    Args:
        entries: the carried entries, and others.
        belief: keys of the belief.
        kinds: kinds of belief of the prefixes.
        stored: source of entries that cannot be computed.

    Raises:
        KeyError: if an entry can neither be computed nor is stored.
    """
    out = dict(entries)
    for key in belief:
        if key in out:
            continue
        value = None
        for kind in kinds:
            if key[:-1] == kind.prefix and kind.carried and all(name in out for name in kind.carry):
                value = kind.derived(key[-1], *(out[name] for name in kind.carry))
        if value is None and stored is not None:
            value = stored.get(key)
        if value is None:
            raise KeyError(
                f"{key!r} cannot be computed from {list(entries)}: let the initial belief write it, or store it with "
                "the belief."
            )
        out[key] = value
    return out
