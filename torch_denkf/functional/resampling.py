r"""Resampling of weighted particles: copies the likely ones and drops the unlikely ones, for the same distribution.

The random numbers are an argument. Particle i is picked at the position :math:`(i + u_i) / E` of the weights'
cumulative sum. One number for all of them is *systematic* resampling: a particle of weight w appears
:math:`\lfloor E w \rfloor` or :math:`\lceil E w \rceil` times. One number for each is *stratified* resampling
(Douc & Cappé 2005, "Comparison of resampling schemes for particle filtering"). Both keep every weight in expectation.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_denkf._checks import check_shape
from torch_denkf.functional.linalg import semidefinite_root
from torch_denkf.functional.moments import ensemble_cov
from torch_denkf.functional.weighted import check_particles


def effective_sample_size(log_weights: Tensor) -> Tensor:
    """Returns the effective number of particles, 1 / Σ w² (Kong et al. 1994): E for equal weights, 1 for a single one.

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
    """Resamples without gradients, neither to the weights nor to the particles.

    The gradient ends at the step, as in the first differentiable particle filter (Jonschkowski et al. 2018,
    arXiv:1805.11122).

    Args:
        particles: X, ``[*B, E, S]``.
        log_weights: log wⁱ, normalised, ``[*B, E]``.
        uniform: numbers in [0, 1): ``[*B, 1]`` for systematic, ``[*B, E]`` for stratified resampling.

    Returns:
        The picked particles, ``[*B, E, S]``, and their equal log-weights −log E, ``[*B, E]``; NaN if a weight is NaN,
        so that the failure stays visible.

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
    r"""Resamples from a mixture with the uniform distribution, whose weights carry the gradient.

    Particles are picked with probability :math:`q^i = (1 - \alpha) w^i + \alpha / E` and get the importance weight
    :math:`w^i / q^i`, normalised, a differentiable function of :math:`w^i` (Karkus, Hsu & Lee 2018, "Particle filter
    networks", arXiv:1805.08975; their :math:`\alpha` is one minus ours).

    Args:
        particles: X, ``[*B, E, S]``.
        log_weights: log wⁱ, normalised, ``[*B, E]``.
        uniform: numbers in [0, 1): ``[*B, 1]`` for systematic, ``[*B, E]`` for stratified resampling.
        alpha: share of the uniform distribution: 0 is hard resampling, 1 keeps the weights unchanged. Kloss et al.
            (2021) use 0.05.

    Returns:
        The picked particles, ``[*B, E, S]``, and their normalised log-weights, ``[*B, E]``.

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
    # The logarithm is taken after picking: a particle that was picked has a positive probability.
    ratio = log_weights.gather(-1, index) - proposal.gather(-1, index).log()
    known = proposal.detach().sum(-1, keepdim=True) > 0
    return _take(particles, index), torch.where(known, ratio.log_softmax(-1), torch.nan)


def jitter_copies(
    resampled: Tensor, particles: Tensor, log_weights: Tensor, normal: Tensor, *, factor: float = 1.0
) -> Tensor:
    r"""Separates the copies of resampling by jitter; one copy of each particle keeps its place.

    It is for motions without noise, in which copies would stay equal. The jitter is Gaussian. Its covariance is that
    of the weighted particles *before* resampling, times the square of :math:`\text{factor} \cdot N^{-1 / (S + 4)}`, the
    rule of Scott for a kernel's width (Musso, Oudjane & Le Gland 2001, "Improving regularised particle filters"). It
    widens the distribution, less so with more particles. N is the *effective* number of particles. A share 1 / N³ of
    the unweighted covariance is added to the weighted one: if one or two particles have all the weight, which says
    little about the spread, the kernel is wide, and a filter that has lost the state can recover it; if a few dozen
    share the weight, the share is negligible. The exponent three was found on Lorenz-63.

    Args:
        resampled: result of :func:`systematic_resample` or :func:`soft_resample`, ``[*B, E, S]``, in which copies are
            adjacent.
        particles: the particles before resampling, ``[*B, E, S]``.
        log_weights: their log-weights before resampling, normalised, ``[*B, E]``.
        normal: standard-normal numbers ``[*B, E, S]``.
        factor: factor of the width; 0 for no jitter.

    Returns:
        The particles, ``[*B, E, S]``.

    Raises:
        ValueError: if the shapes do not fit, or ``factor`` is negative.

    Examples:
        >>> import torch
        >>> particles, picked = torch.tensor([[0.0], [1.0], [2.0]]), torch.tensor([[1.0], [1.0], [2.0]])
        >>> even, normal = torch.full((3,), 1 / 3).log(), torch.ones(3, 1)
        >>> jitter_copies(picked, particles, even, normal, factor=0.5).flatten()
        tensor([1.0000, 1.3367, 2.0000])

        N is 3 here: the second copy of 1 is moved by 3^(-1/5) / 2, times the root of the covariance 2 / 3 + 1 / 27.
    """
    check_particles(particles, log_weights)
    check_shape("resampled", resampled, particles.shape, "[*B, E, S]")
    check_shape("normal", normal, particles.shape, "[*B, E, S]")
    if factor < 0:
        raise ValueError(f"factor scales the jitter's width, 0 or more; got {factor}.")
    dim = particles.shape[-1]
    weights, count = log_weights.exp().unsqueeze(-1), effective_sample_size(log_weights)[..., None, None]
    anomalies = particles - (weights * particles).sum(-2, keepdim=True)
    cov = anomalies.mT @ (weights * anomalies) + ensemble_cov(particles) / count**3
    width = factor * count ** (-1 / (dim + 4))
    same = (resampled[..., 1:, :] == resampled[..., :-1, :]).all(-1, keepdim=True)
    copies = torch.cat([torch.zeros_like(same[..., :1, :]), same], -2)
    return resampled + torch.where(copies, width * (normal @ semidefinite_root(cov).mT), 0)


def _pick(probability: Tensor, uniform: Tensor) -> Tensor:
    """Returns indices ``[*B, E]`` at the positions (i + u) / E of the cumulative probability."""
    size = probability.shape[-1]
    if uniform.shape not in (probability.shape, (*probability.shape[:-1], 1)):
        raise ValueError(
            f"uniform must be [*B, 1] = {[*probability.shape[:-1], 1]} or [*B, E] = {list(probability.shape)}, got "
            f"{list(uniform.shape)}; draw it with torch.rand"
        )
    rank = torch.arange(size, dtype=probability.dtype, device=probability.device)
    cumulative = probability.cumsum(-1)
    # The last is exactly 1 and all positions are below, also after rounding: each index has a positive probability.
    cumulative = cumulative / cumulative[..., -1:]
    below_one = 1 - torch.finfo(probability.dtype).eps / 2
    position = ((rank + uniform.to(probability.dtype)) / size).clamp(max=below_one)
    # If a weight is NaN, no position is found: the index is clamped, and the weights become NaN.
    return torch.searchsorted(cumulative, position.contiguous(), right=True).clamp(max=size - 1)


def _take(particles: Tensor, index: Tensor) -> Tensor:
    return particles.gather(-2, index.unsqueeze(-1).expand(*index.shape, particles.shape[-1]))
