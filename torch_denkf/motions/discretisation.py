r"""A linear motion in continuous time, over a step of any length."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_denkf._checks import check_one_dtype, check_shape


def discretise(drift: Tensor, density: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
    r"""Discretises :math:`dx = A x\,dt + d\beta`, where :math:`\beta` is a Brownian motion of spectral density D.

    .. math:: F = e^{A \Delta t}, \quad Q = \int_0^{\Delta t} e^{A s} D e^{A^T s} ds

    Both come from one matrix exponential.

    Args:
        drift: A, ``[S, S]``, per second.
        density: D, ``[S, S]``, a covariance per second.
        dt: length of the step in seconds, ``[*B, 1]``; 0 gives the identity and no noise.

    Returns:
        F and Q, ``[*B, S, S]`` each.

    Raises:
        ValueError: if the shapes do not fit.

    Source:
        Van Loan, "Computing integrals involving the matrix exponential", IEEE Trans. Automatic Control 23, 1978.

    Examples:
        A body that white noise accelerates:

        >>> import torch
        >>> drift, density = torch.tensor([[0.0, 1.0], [0.0, 0.0]]), torch.diag(torch.tensor([0.0, 3.0]))
        >>> discretise(drift, density, torch.tensor([2.0]))[1]
        tensor([[8., 6.],
                [6., 6.]])
    """
    size = drift.shape[-1]
    check_shape("drift", drift, (size, size), "[S, S]")
    check_shape("density", density, (size, size), "[S, S]")
    check_one_dtype(drift=drift, density=density, dt=dt)
    block = torch.cat([torch.cat([-drift, density], -1), torch.cat([torch.zeros_like(drift), drift.mT], -1)], -2)
    exponential = torch.linalg.matrix_exp(block * dt.unsqueeze(-1))
    motion = exponential[..., size:, size:].mT
    noise = motion @ exponential[..., :size, size:]
    return motion, (noise + noise.mT) / 2
