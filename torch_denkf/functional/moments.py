"""Mean, anomalies and (co)variance of an ensemble ``[*B, E, S]``: E members of an S-dimensional state."""

from __future__ import annotations

from torch import Tensor

from torch_denkf._checks import check_ensemble
from torch_denkf.functional.kernels.small_system import on_gpu


def ensemble_mean(ensemble: Tensor) -> Tensor:
    """Returns the ensemble mean x̄ = 1/E Σ xⁱ, the filter's point estimate (Section III-C of the paper).

    Args:
        ensemble: X, ``[*B, E, S]``, in the state's units.

    Returns:
        x̄, ``[*B, S]``.

    Raises:
        ValueError: if ``ensemble`` has fewer than two dimensions or no members.

    Examples:
        >>> import torch
        >>> ensemble_mean(torch.tensor([[1.0, 2.0], [3.0, 6.0]]))
        tensor([2., 4.])
    """
    if ensemble.ndim < 2 or not ensemble.shape[-2]:
        check_ensemble("ensemble", ensemble)
    return ensemble.mean(-2)


def ensemble_anomalies(ensemble: Tensor) -> Tensor:
    """Returns the members' deviations from their mean, A = X − x̄ (eqs. 7 and 10 of the paper).

    Args:
        ensemble: X, ``[*B, E, S]``, in the state's units.

    Returns:
        A, ``[*B, E, S]``; it sums to zero over the members.

    Raises:
        ValueError: if ``ensemble`` has fewer than two dimensions or no members.

    Examples:
        >>> import torch
        >>> ensemble_anomalies(torch.tensor([[1.0, 2.0], [3.0, 6.0]]))
        tensor([[-1., -2.],
                [ 1.,  2.]])
    """
    check_ensemble("ensemble", ensemble)
    return ensemble - ensemble.mean(-2, keepdim=True)


def ensemble_var(ensemble: Tensor, mean: Tensor | None = None) -> Tensor:
    """Returns the unbiased sample variance of each component, Σ (xⁱ − x̄)² / (E − 1).

    Args:
        ensemble: X, ``[*B, E, S]``, in the state's units.
        mean: its mean, ``[*B, S]``, if known already.

    Returns:
        The variances, ``[*B, S]``, in the state's units squared.

    Raises:
        ValueError: if ``ensemble`` has fewer than two dimensions or members.

    Examples:
        >>> import torch
        >>> ensemble_var(torch.tensor([[1.0, 2.0], [3.0, 6.0]]))
        tensor([2., 8.])
    """
    if ensemble.ndim < 2 or ensemble.shape[-2] < 2:
        check_ensemble("ensemble", ensemble, min_size=2)
    if on_gpu(ensemble):
        return ensemble.var(-2)
    # Twice as fast as var() over a dimension that is not the last, which is not vectorised; both are exact.
    anomalies = ensemble - (ensemble.mean(-2) if mean is None else mean).unsqueeze(-2)
    return anomalies.square().sum(-2) / (ensemble.shape[-2] - 1)


def ensemble_cov(ensemble: Tensor) -> Tensor:
    """Returns the unbiased sample covariance AᵀA / (E − 1), for diagnostics; the analysis never computes it.

    Args:
        ensemble: X, ``[*B, E, S]``, in the state's units.

    Returns:
        The covariances, ``[*B, S, S]``, in the state's units squared.

    Raises:
        ValueError: if ``ensemble`` has fewer than two dimensions or members.

    Examples:
        >>> import torch
        >>> ensemble_cov(torch.tensor([[1.0, 2.0], [3.0, 6.0]]))
        tensor([[2., 4.],
                [4., 8.]])
    """
    check_ensemble("ensemble", ensemble, min_size=2)
    anomalies = ensemble_anomalies(ensemble)
    return anomalies.mT @ anomalies / (ensemble.shape[-2] - 1)
