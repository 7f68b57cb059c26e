"""Resampling by optimal transport: no particle is picked or lost, all of them move a little."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_denkf.functional.weighted import check_particles, weighted_mean

#: Initial regularisation of Sinkhorn's iterations, in squared standard deviations, and the share of iterations in
#: which it decreases to its final value.
_COARSE, _COARSE_SHARE = 2.0, 0.25


def transport_resample(
    particles: Tensor, log_weights: Tensor, *, epsilon: float = 0.05, iterations: int = 20
) -> tuple[Tensor, Tensor]:
    r"""Moves weighted particles to equally weighted ones along an entropy-regularised optimal transport plan.

    .. math:: \tilde x^i = \bar x + E \sum_j P_{ij} (x^j - \bar x), \qquad
        P = \arg\min \sum_{ij} P_{ij} C_{ij} + \epsilon\, \mathrm{KL}(P \,\|\, 1/E \otimes w)

    with rows of P summing to 1/E and columns to :math:`w^j` (Corenflos, Thornton, Deligiannidis & Doucet 2021,
    "Differentiable particle filtering via entropy-regularized optimal transport", arXiv:2102.07850).
    It has no randomness, and is differentiable in particles and weights, through Sinkhorn's iterations in the log
    domain with a regularisation that decreases to :math:`\epsilon` (Schmitzer 2019, "Stabilized sparse scaling
    algorithms for entropy regularized transport problems"). The backward pass stores a few matrices ``[*B, E, E]`` for
    each iteration.

    The cost is :math:`C_{ij} = \|(x^i - x^j) / \sigma\|^2 / 2` with the unweighted standard deviation :math:`\sigma`
    of each dimension, so that units do not matter. The weighted mean is kept to rounding, even if the iterations have
    not converged. The spread shrinks: for a Gaussian in independent dimensions, and particles k times as wide as
    their weighted distribution, the standard deviation is multiplied by :math:`\sqrt{1 + c^2} - c`,
    :math:`c = k \epsilon / 2` (0.95 for :math:`\epsilon = 0.05` and k = 2). More particles do not remove this bias.

    Args:
        particles: X, ``[*B, E, S]``.
        log_weights: log wⁱ, normalised, ``[*B, E]``.
        epsilon: regularisation, relative to a squared standard deviation.
        iterations: number of Sinkhorn's iterations; a smaller ``epsilon`` needs more.

    Returns:
        The moved particles, ``[*B, E, S]``, and their equal log-weights −log E, ``[*B, E]``.

    Raises:
        ValueError: if the shapes do not fit, or if ``epsilon`` or ``iterations`` is not positive.

    Examples:
        >>> import torch
        >>> particles, weights = torch.tensor([[0.0], [1.0]]), torch.tensor([0.25, 0.75])
        >>> moved, _ = transport_resample(particles, weights.log(), iterations=100)
        >>> moved.flatten()  # half of the first's share comes from the second
        tensor([0.5000, 1.0000])
    """
    check_particles(particles, log_weights, min_size=2)
    if epsilon <= 0 or iterations < 1:
        raise ValueError(f"epsilon and iterations must be positive; got {epsilon} and {iterations}.")
    size = particles.shape[-2]
    mean = weighted_mean(particles, log_weights).unsqueeze(-2)
    # A particle of zero weight is moved like any other, but its position has no information, however distant.
    anomalies = torch.where(log_weights.exp().unsqueeze(-1) > 0, particles - mean, 0)
    # Not the weighted variance: if one particle has all the weight, it would be zero, and Sinkhorn would stall.
    variance = anomalies.var(-2, keepdim=True)
    scale = torch.where(variance > 0, 2 * variance, 1).sqrt()
    scaled = anomalies / scale
    # ||a - b||^2 from its three terms, without a tensor [E, E, S].
    square = scaled.square().sum(-1)
    cost = square.unsqueeze(-1) + square.unsqueeze(-2) - 2 * scaled @ scaled.mT

    row = torch.zeros_like(log_weights)  # the dual potentials of the rows, and of the columns
    for iteration in range(iterations):
        # From coarse to fine: potentials take larger steps under a stronger regularisation.
        coarse = max(1 - (iteration + 1) / (_COARSE_SHARE * iterations), 0)
        sharp = epsilon * (max(_COARSE, epsilon) / epsilon) ** coarse
        column = sharp * (math.log(size) - torch.logsumexp((row.unsqueeze(-1) - cost) / sharp, -2))
        # The rows last, so that their sums are exact and each particle becomes an average of others: with the columns
        # last, particles move far out if the iterations have not converged.
        log_column = (column.unsqueeze(-2) - cost) / sharp + log_weights.unsqueeze(-2)
        row = -sharp * torch.logsumexp(log_column, -1)
    moved = torch.exp(row.unsqueeze(-1) / sharp + log_column) @ anomalies  # E P
    # The remaining error of the columns' sums shifts the mean; a common shift corrects it.
    moved = moved - moved.mean(-2, keepdim=True)
    return mean + moved, torch.full_like(log_weights, -math.log(size)).detach()
