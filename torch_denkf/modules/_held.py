"""A belief that explodes: its variances are held at a ceiling."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from math import sqrt

import torch
from tensordict import NestedKey
from torch import Tensor

from torch_denkf._checks import flag_value
from torch_denkf.functional.manifolds import Space
from torch_denkf.functional.weighted import weighted_mean, weighted_median
from torch_denkf.submodel import Entries

__all__ = ["hold_variances"]

#: The mean is held within so many of the largest standard deviations that a variance ceiling allows.
_FARTHEST = 1000.0


def hold_variances(
    written: Entries,
    belief: Iterable[NestedKey],
    ceiling: float,
    say: Callable[[NestedKey], None],
    space: Space | None = None,
) -> None:
    """Holds the variances at the ceiling, in place of the entries ``written``; the correlations stay.

    An ensemble moves as a whole. Of weighted particles only those move that lie so far from the weighted median that
    they make the variance too large: the others are what is known, and a reading will tell.

    Args:
        written: what a step wrote; changed.
        belief: keys of the belief.
        ceiling: largest variance, in the state's units squared.
        say: told which variance is held.
        space: in which the state lives; there the mean stays, and particles do.
    """
    for key in belief:
        variance = written.get(key) if key[-1] == "var" else None
        if variance is None:
            continue
        # Not known where to look would wait for a device, or is not possible.
        unknown = torch.compiler.is_compiling() or variance.is_cuda
        exceeded = None if unknown else flag_value((variance > ceiling).any())
        if exceeded is False:
            continue
        if exceeded:
            say(key)
        prefix, farthest = key[:-1], _FARTHEST * sqrt(ceiling)
        mean_key = (*prefix, "mean")
        mean = written.get(mean_key)
        if mean is None:
            continue
        factor = (variance / ceiling).clamp(min=1).rsqrt()
        written[key] = variance * factor.square()
        log_weight = written.get((*prefix, "log_weight"))
        cov, ensemble = written.get((*prefix, "cov")), written.get((*prefix, "ensemble"))
        if space is not None:
            if cov is not None:
                written[*prefix, "cov"] = cov * factor.unsqueeze(-1) * factor.unsqueeze(-2)
            if ensemble is not None and log_weight is None:
                center = mean.unsqueeze(-2)
                limited = space.plus(center, space.minus(ensemble, center) * factor.unsqueeze(-2))
                written[*prefix, "ensemble"] = torch.where((factor < 1).any(-1)[..., None, None], limited, ensemble)
            continue
        if log_weight is not None:
            particles = _held_particles(written[*prefix, "ensemble"], log_weight, factor < 1, ceiling, farthest)
            written[mean_key] = torch.where(factor < 1, weighted_mean(particles, log_weight), mean)
            written[*prefix, "ensemble"] = particles
            continue
        held = mean.clamp(-farthest, farthest)
        written[mean_key] = held
        if cov is not None:
            written[*prefix, "cov"] = cov * factor.unsqueeze(-1) * factor.unsqueeze(-2)
        if ensemble is not None:
            deviations = (ensemble - mean.unsqueeze(-2)) * factor.unsqueeze(-2)
            limited = held.unsqueeze(-2) + deviations
            # Where nothing is held, nothing moves, not even by rounding.
            same = ((factor == 1) & (held == mean)).unsqueeze(-2)
            written[*prefix, "ensemble"] = torch.where(same, ensemble, limited)


def _held_particles(
    particles: Tensor, log_weights: Tensor, exceeded: Tensor, ceiling: float, farthest: float
) -> Tensor:
    """Particles within one largest deviation of their weighted median, in the components that exceed the ceiling."""
    centre = weighted_median(particles, log_weights).clamp(-farthest, farthest).unsqueeze(-2)
    held = particles.clamp(centre - sqrt(ceiling), centre + sqrt(ceiling))
    return torch.where(exceeded.unsqueeze(-2), held, particles)
