"""Corrections of an ensemble's spread: inflation, relaxation to the forecast's spread, random rotation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_denkf._checks import check_ensemble, check_shape
from torch_denkf.functional.kernels.small_system import on_gpu


def inflate(ensemble: Tensor, factor: float | Tensor) -> Tensor:
    """Inflates the ensemble about its mean, x̄ + factor A (Anderson & Anderson 1999).

    Args:
        ensemble: X, ``[*B, E, S]``, in the state's units.
        factor: factor of the standard deviation (the variance is multiplied by its square); a number or a
            tensor that broadcasts to ``[*B, E, S]``.

    Returns:
        The inflated ensemble, ``[*B, E, S]``, with the same mean.

    Raises:
        ValueError: if ``ensemble`` has fewer than two dimensions or no members.

    Examples:
        >>> import torch
        >>> inflate(torch.tensor([[1.0], [3.0]]), 1.5).flatten()
        tensor([0.5000, 3.5000])
    """
    check_ensemble("ensemble", ensemble)
    mean = ensemble.mean(-2, keepdim=True)
    return mean + factor * (ensemble - mean)


def relax_to_prior_spread(analysis: Tensor, forecast: Tensor, relaxation: float | Tensor) -> Tensor:
    """Relaxes the analysis to the prior spread (Whitaker & Hamill 2012, Mon. Wea. Rev. 140).

    Each component's anomalies are multiplied by 1 − α + α σ_f / σ_a, so that its standard deviation
    becomes (1 − α) σ_a + α σ_f. A component without analysis spread is unchanged, with finite gradients.

    Args:
        analysis: the analysis ensemble, ``[*B, E, S]``, in the state's units.
        forecast: the forecast ensemble, ``[*B, E, S]``, in the state's units.
        relaxation: α, 0 (the analysis' spread) to 1 (the forecast's); a number or a tensor that
            broadcasts to ``[*B, 1, S]``.

    Returns:
        The relaxed ensemble, ``[*B, E, S]``, with the analysis' mean.

    Raises:
        ValueError: if the shapes differ or there are fewer than two members.

    Examples:
        >>> import torch
        >>> analysis, forecast = torch.tensor([[-1.0], [1.0]]), torch.tensor([[-3.0], [3.0]])
        >>> relax_to_prior_spread(analysis, forecast, 0.5).flatten()
        tensor([-2.,  2.])
    """
    check_ensemble("analysis", analysis, min_size=2)
    check_shape("forecast", forecast, analysis.shape, "[*B, E, S], as analysis,")
    mean = analysis.mean(-2, keepdim=True)
    ratio = _safe_sqrt(forecast.var(-2, keepdim=True)) / _safe_sqrt(analysis.var(-2, keepdim=True), empty=1)
    return mean + (1 - relaxation + relaxation * ratio) * (analysis - mean)


def random_rotation(
    ensemble_size: int,
    batch_shape: Sequence[int] = (),
    *,
    generator: torch.Generator | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Draws random orthogonal matrices that keep the vector of ones, for the members of a square-root filter.

    They change the members but neither their mean nor their covariance, and so remove the outliers that a
    deterministic filter develops in nonlinear systems (Sakov & Oke 2008, Mon. Wea. Rev. 136). The distribution is
    uniform (Haar) over all such matrices.

    Args:
        ensemble_size: E, at least 2.
        batch_shape: the leading dimensions, ``*B``.
        generator: source of randomness; None: torch's default generator.
        dtype: floating type of the result; None: torch's default.
        device: device of the result; None: torch's default.

    Returns:
        Ω, ``[*B, E, E]``, with Ω Ωᵀ = I and Ω 1 = 1.

    Raises:
        ValueError: if ``ensemble_size`` is less than 2.

    Examples:
        >>> import torch
        >>> rotation = random_rotation(4, generator=torch.Generator().manual_seed(0))
        >>> torch.allclose(rotation @ rotation.mT, torch.eye(4), atol=1e-6)
        True
        >>> torch.allclose(rotation.sum(-1), torch.ones(4))
        True
    """
    if ensemble_size < 2:
        raise ValueError(f"ensemble_size must be at least 2, got {ensemble_size}")
    shape = (*batch_shape, ensemble_size - 1, ensemble_size - 1)
    gaussian = torch.randn(shape, generator=generator, dtype=dtype, device=device)
    if on_gpu(gaussian):
        orthogonal = _orthogonal(gaussian)
    else:
        orthogonal, triangular = torch.linalg.qr(gaussian)
        # Without these signs the draw would depend on the QR convention (Mezzadri 2007).
        signs = torch.where(triangular.diagonal(dim1=-2, dim2=-1) < 0, -1.0, 1.0).to(gaussian.dtype)
        orthogonal = orthogonal * signs.unsqueeze(-2)
    # The reflection that swaps the first axis and the direction of ones: its other columns span the rest.
    normal = torch.full((ensemble_size,), -(ensemble_size**-0.5), dtype=dtype, device=device)
    normal[0] += 1
    reflection = torch.eye(ensemble_size, dtype=dtype, device=device)
    reflection = reflection - 2 * normal.outer(normal) / normal.dot(normal)
    basis = reflection[:, 1:]
    return basis @ orthogonal @ basis.mT + 1 / ensemble_size


def _orthogonal(gaussian: Tensor) -> Tensor:
    """Makes uniform orthogonal matrices without a QR decomposition, which waits for a GPU.

    It multiplies Householder reflections of independent vectors, each one component shorter than the last (Stewart
    1980, "The efficient generation of random orthogonal matrices", SIAM J. Numer. Anal. 17): the columns of the lower
    triangle. The product is I − V T Vᵀ, and the inverse of T is the upper triangle of VᵀV with its diagonal halved.
    """
    columns = gaussian.tril()
    signs = gaussian.diagonal(dim1=-2, dim2=-1).sign().unsqueeze(-2)
    columns = columns + (signs * torch.linalg.vector_norm(columns, dim=-2, keepdim=True)).squeeze(-2).diag_embed()
    columns = columns / torch.linalg.vector_norm(columns, dim=-2, keepdim=True)
    identity = torch.eye(gaussian.shape[-1], dtype=gaussian.dtype, device=gaussian.device)
    inverse = (columns.mT @ columns).triu(1) + identity / 2
    return signs * (columns @ torch.linalg.solve_triangular(inverse, columns.mT, upper=True) - identity)


def _safe_sqrt(variance: Tensor, empty: float = 0) -> Tensor:
    positive = variance > 0
    return torch.where(positive, torch.where(positive, variance, 1).sqrt(), empty)
