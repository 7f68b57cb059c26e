"""A Cholesky solution of a few unknowns written out, for compilers: it melts into the arithmetic around it.

In a compiled step LAPACK's calls for a 2 x 2 system cost more than the system: they cannot be fused, each costs a
call, and in a package (AOTInductor) they go through a slow fallback. Eagerly, LAPACK is the faster one.
"""

from __future__ import annotations

import torch
from torch import Tensor

#: The largest O that is written out; the number of operations grows with its cube.
LARGEST = 4


def solve_written_out(gram: Tensor, cross: Tensor, shift: Tensor, mean_shift: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Solve with I + G, G symmetric and O x O, without a call of LAPACK or a product of matrices.

    Args:
        gram: G, ``[*B, O, O]`` with O of 1 to 4; its lower triangle is read.
        cross: right-hand sides C, ``[*B, O, S]``.
        shift: rows D, ``[*B, E, O]`` or ``[*B, 1, O]``.
        mean_shift: one row d, ``[*B, 1, O]``.

    Returns:
        D (I + G)⁻¹ C, ``[*B, E, S]``; d (I + G)⁻¹ dᵀ and log det (I + G), ``[*B, 1]`` each. NaN where I + G is not
        positive definite.

    Examples:
        >>> one = torch.ones(1, 1)
        >>> increment, square, log_det = solve_written_out(3 * one, one, 2 * one, 2 * one)
        >>> increment.item(), square.item(), log_det.exp().item()
        (0.5, 1.0, 4.0)
    """
    size = gram.shape[-1]
    lower: list[list[Tensor]] = []  # L, each element [*B, 1]
    for i in range(size):
        row: list[Tensor] = []
        for j in range(i + 1):
            rest = gram[..., i, j, None]
            for k in range(j):
                rest = rest - row[k] * (lower[j][k] if j < i else row[k])
            if j < i:
                row.append(rest / lower[j][j])
            else:
                pivot = rest + 1
                row.append(torch.where(pivot > 0, pivot, torch.nan).sqrt())
        lower.append(row)

    def forward(values: list[Tensor]) -> list[Tensor]:
        solved: list[Tensor] = []
        for i in range(size):
            rest = values[i]
            for k in range(i):
                rest = rest - lower[i][k] * solved[k]
            solved.append(rest / lower[i][i])
        return solved

    solved = forward([cross[..., i, :] for i in range(size)])
    for i in reversed(range(size)):  # with the transpose of L, in place
        for k in range(i + 1, size):
            solved[i] = solved[i] - lower[k][i] * solved[k]
        solved[i] = solved[i] / lower[i][i]
    increment = sum(shift[..., i, None] * solved[i].unsqueeze(-2) for i in range(size))
    square = sum(value.square() for value in forward([mean_shift[..., 0, i, None] for i in range(size)]))
    log_det = 2 * sum(lower[i][i].log() for i in range(size))
    return increment, square, log_det
