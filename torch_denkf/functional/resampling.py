r"""Resampling of weighted particles: many copies of the likely ones, none of the unlikely, the same distribution.

The random numbers come in as an argument. Particle i is picked at the position :math:`(i + u_i) / E` of the weights'
cumulative sum: one number for all of them is *systematic* resampling, where a particle of weight w appears
:math:`\lfloor E w \rfloor` or :math:`\lceil E w \rceil` times; one number each is *stratified* resampling
(Douc & Cappé 2005, "Comparison of resampling schemes for particle filtering"). Both keep every weight in expectation.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_denkf.functional.weighted import check_particles


def effective_sample_size(log_weights: Tensor) -> Tensor:
    """The effective number of particles, 1 / Σ w² (Kong et al. 1994): E for equal weights, 1 for a single one.

    Args:
        log_weights: log wⁱ, normalised, ``[*B, E]``.

    Returns:
        The effective numbers, ``[*B]``.

    Examples:
        >>> import torch
        >>> effective_sample_size(torch.tensor([0.5, 0.5, 0.0, 0.0]).log())
        tensor(2.)
    """
    return torch.exp(-torch.logsumexp(2 * log_weights, -1))


def systematic_resample(particles: Tensor, log_weights: Tensor, uniform: Tensor) -> tuple[Tensor, Tensor]:
    """Hard resampling, through which no gradient flows, neither to the weights nor to the particles.

    As in the first differentiable particle filter, whose gradient ends at the step (Jonschkowski et al. 2018,
    arXiv:1805.11122).

    Args:
        particles: X, ``[*B, E, S]``.
        log_weights: log wⁱ, normalised, ``[*B, E]``.
        uniform: numbers in [0, 1): ``[*B, 1]`` for systematic, ``[*B, E]`` for stratified resampling.

    Returns:
        The particles that were picked, ``[*B, E, S]``, and their equal log-weights −log E, ``[*B, E]``. These are NaN
        where a weight was, so that it is not lost.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> particles, weights = torch.tensor([[1.0], [2.0]]), torch.tensor([0.2, 0.8])
        >>> systematic_resample(particles, weights.log(), torch.tensor([0.5]))[0].flatten()
        tensor([2., 2.])
    """
    check_particles(particles, log_weights)
    probability = log_weights.detach().exp()
    index = _pick(probability, uniform)
    equal = torch.full_like(probability, -math.log(log_weights.shape[-1]))
    return _take(particles.detach(), index), torch.where(probability.sum(-1, keepdim=True) > 0, equal, torch.nan)


def soft_resample(
    particles: Tensor, log_weights: Tensor, uniform: Tensor, alpha: float = 0.05
) -> tuple[Tensor, Tensor]:
    r"""Resampling from a mixture with the uniform distribution, whose weights carry the gradient.

    Particles are picked with probability :math:`q^i = (1 - \alpha) w^i + \alpha / E` and get the importance weight
    :math:`w^i / q^i`, normalised, a differentiable function of :math:`w^i` (Karkus, Hsu & Lee 2018, "Particle filter
    networks", arXiv:1805.08975; their :math:`\alpha` is one minus ours).

    Args:
        particles: X, ``[*B, E, S]``.
        log_weights: log wⁱ, normalised, ``[*B, E]``.
        uniform: numbers in [0, 1): ``[*B, 1]`` for systematic, ``[*B, E]`` for stratified resampling.
        alpha: share of the uniform distribution: 0 is hard resampling, 1 leaves the weights as they are. Kloss et al.
            (2021) use 0.05.

    Returns:
        The particles that were picked, ``[*B, E, S]``, and their normalised log-weights, ``[*B, E]``.

    Raises:
        ValueError: if the shapes do not fit, or if ``alpha`` is outside [0, 1].

    Examples:
        >>> import torch
        >>> particles, weights = torch.tensor([[1.0], [2.0]]), torch.tensor([0.2, 0.8])
        >>> soft_resample(particles, weights.log(), torch.tensor([0.5]), alpha=1.0)[1].exp()
        tensor([0.2000, 0.8000])
    """
    check_particles(particles, log_weights)
    if not 0 <= alpha <= 1:
        raise ValueError(f"alpha is the share of the uniform distribution, between 0 and 1; got {alpha}.")
    proposal = (1 - alpha) * log_weights.exp() + alpha / log_weights.shape[-1]
    index = _pick(proposal.detach(), uniform)
    # Picked first, then their logarithm: a particle that was picked has a positive probability.
    ratio = log_weights.gather(-1, index) - proposal.gather(-1, index).log()
    known = proposal.detach().sum(-1, keepdim=True) > 0
    return _take(particles, index), torch.where(known, ratio.log_softmax(-1), torch.nan)


def _pick(probability: Tensor, uniform: Tensor) -> Tensor:
    """Indices ``[*B, E]`` at the positions (i + u) / E of the cumulative probability."""
    size = probability.shape[-1]
    if uniform.shape not in (probability.shape, (*probability.shape[:-1], 1)):
        raise ValueError(
            f"uniform must be [*B, 1] = {[*probability.shape[:-1], 1]} or [*B, E] = {list(probability.shape)}, got "
            f"{list(uniform.shape)}; draw it with torch.rand"
        )
    rank = torch.arange(size, dtype=probability.dtype, device=probability.device)
    cumulative = probability.cumsum(-1)
    # The last is exactly 1 and all positions are below, also after rounding: what is found has a positive probability.
    cumulative = cumulative / cumulative[..., -1:]
    below_one = 1 - torch.finfo(probability.dtype).eps / 2
    position = ((rank + uniform.to(probability.dtype)) / size).clamp(max=below_one)
    # Where a weight is NaN, no position is found: the index stays inside, and the weights tell.
    return torch.searchsorted(cumulative, position.contiguous(), right=True).clamp(max=size - 1)


def _take(particles: Tensor, index: Tensor) -> Tensor:
    return particles.gather(-2, index.unsqueeze(-1).expand(*index.shape, particles.shape[-1]))
