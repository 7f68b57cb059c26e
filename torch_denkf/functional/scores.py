"""Proper scores of an ensemble forecast: lower is better; the true distribution has the lowest expected score.

Source: Gneiting & Raftery 2007, JASA 102, eqs. 21 and 22; the fair variants, whose expectation does not
depend on the ensemble's size, Ferro 2014, Q. J. R. Meteorol. Soc. 140.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_denkf._checks import check_ensemble, check_shape
from torch_denkf.functional.weighted import check_particles


def crps_ensemble(ensemble: Tensor, target: Tensor, log_weights: Tensor | None = None, *, fair: bool = True) -> Tensor:
    """Returns the continuous ranked probability score of each component: ``E|x − y| − 1/2 E|x − x'|``.

    Sorting reduces the double sum over pairs to a single one: O(E log E) time, O(E) memory.

    Args:
        ensemble: X, ``[*B, E, S]``, in the state's units.
        target: the truth y, ``[*B, S]``, in the state's units.
        log_weights: log-weights of particles, normalised, ``[*B, E]``: the score is that of the weighted empirical
            distribution, ``Σ wⁱ|xⁱ − y| − 1/2 Σ Σ wⁱwʲ|xⁱ − xʲ|``, and ``fair`` is ignored.
        fair: average ``|x − x'|`` over the E (E − 1) pairs of different members, for an unbiased estimate of the
            score of the distribution from which they are drawn; otherwise over all E² pairs, for the score of the
            empirical distribution.

    Returns:
        The scores, ``[*B, S]``, in the state's units.

    Raises:
        ValueError: if the shapes do not fit, or if ``fair`` and there are fewer than two members without weights.

    Examples:
        >>> import torch
        >>> crps_ensemble(torch.tensor([[0.0], [2.0]]), torch.tensor([1.0]), fair=False)
        tensor([0.5000])
        >>> crps_ensemble(torch.tensor([[0.0], [2.0]]), torch.tensor([0.0]), torch.tensor([0.75, 0.25]).log())
        tensor([0.1250])
    """
    size = _check(ensemble, target, fair and log_weights is None)
    # Differences to the target before sorting, which lose no digits if the mean is much larger than the spread.
    error, order = (ensemble - target.unsqueeze(-2)).sort(-2)
    if log_weights is not None:
        check_particles(ensemble, log_weights)
        weight = log_weights.exp().unsqueeze(-1).expand_as(error).gather(-2, order)
        below = weight.cumsum(-2)  # the weight of all particles up to this one
        return (weight * (error.abs() - (2 * below - weight - 1) * error)).sum(-2)
    rank = torch.arange(size, dtype=error.dtype, device=error.device)
    weights = (2 * rank - (size - 1)) / (size * (size - 1 if fair else size))
    return error.abs().mean(-2) - weights @ error


def crps_gaussian(mean: Tensor, variance: Tensor, target: Tensor) -> Tensor:
    r"""Returns the continuous ranked probability score of a Gaussian, per dimension (Gneiting et al. 2005, eq. 5).

    .. math:: \sigma \left( z (2 \Phi(z) - 1) + 2 \varphi(z) - 1/\sqrt{\pi} \right), \quad z = (y - m) / \sigma

    Args:
        mean: m, ``[*B, S]``.
        variance: :math:`\sigma^2`, positive, ``[*B, S]``.
        target: the truth y, ``[*B, S]``.

    Returns:
        The scores, ``[*B, S]``, in the units of the target.

    Raises:
        ValueError: if the shapes do not fit.

    Examples:
        >>> import torch
        >>> crps_gaussian(torch.zeros(1), torch.ones(1), torch.zeros(1))
        tensor([0.2337])
    """
    for name, value in (("variance", variance), ("target", target)):
        check_shape(name, value, tuple(mean.shape), "[*B, S]")
    std = variance.sqrt()
    z = (target - mean) / std
    density = torch.exp(-0.5 * z.square()) / math.sqrt(2 * math.pi)
    return std * (z * torch.erf(z / math.sqrt(2)) + 2 * density - 1 / math.sqrt(math.pi))


def energy_score(ensemble: Tensor, target: Tensor, *, fair: bool = True) -> Tensor:
    """Returns the energy score of the whole vector, E‖x − y‖ − 1/2 E‖x − x'‖: the CRPS in more than one dimension.

    It costs O(E² S) time and O(E²) memory. Components of different units should be scaled first.

    Args:
        ensemble: X, ``[*B, E, S]``.
        target: the truth y, ``[*B, S]``.
        fair: average over pairs of different members, as in :func:`crps_ensemble`.

    Returns:
        The scores, ``[*B]``.

    Raises:
        ValueError: if the shapes do not fit, or if ``fair`` and there are fewer than two members.

    Examples:
        >>> import torch
        >>> energy_score(torch.tensor([[0.0, 0.0], [6.0, 8.0]]), torch.zeros(2), fair=False)
        tensor(2.5000)
    """
    size = _check(ensemble, target, fair)
    to_target = torch.linalg.vector_norm(ensemble - target.unsqueeze(-2), dim=-1).mean(-1)
    # cdist by plain differences: its matrix product route would lose digits between close members.
    pairs = torch.cdist(ensemble, ensemble, compute_mode="donot_use_mm_for_euclid_dist")
    return to_target - pairs.sum((-2, -1)) / (2 * size * (size - 1 if fair else size))


def _check(ensemble: Tensor, target: Tensor, fair: bool) -> int:
    check_ensemble("ensemble", ensemble, min_size=2 if fair else 1)
    check_shape("target", target, (*ensemble.shape[:-2], ensemble.shape[-1]), "[*B, S]")
    return ensemble.shape[-2]
