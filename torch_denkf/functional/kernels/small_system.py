"""Cholesky factors and solutions of a few unknowns written out, for compilers: they melt into what is around them.

In a compiled step LAPACK's calls for a 2 x 2 system cost more than the system: they cannot be fused, each costs a
call, and in C++ (a filter's ``compile()`` on a processor, a package of AOTInductor) some go through a slow fallback.
Eagerly, LAPACK is the faster one on a processor. On a GPU, torch's routines for batches of systems wait for the device,
or cannot be captured into a CUDA graph, as MAGMA's: :func:`inverse_of` takes their place there.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence

import torch
from torch import Tensor

#: The largest O that is written out; the number of operations grows with its cube.
LARGEST = 4
#: The largest matrix whose factor alone is written out, of a state's covariance, say.
LARGEST_FACTOR = 6
#: Kinds of devices on which a call costs a launch, and a look at a result waits for all launches before it.
GPUS = ("cuda",)


_MADE: dict[Hashable, Tensor] = {}


def made_once(key: Hashable, make: Callable[[], Tensor]) -> Tensor:
    """Returns a constant tensor that is made in the first call: no copy to the device is captured into a graph later.

    A tensor that holds no numbers, as compilers trace with, is not kept.

    Args:
        key: of the constant; its device among it.
        make: makes it.
    """
    if key in _MADE:
        return _MADE[key]
    made = make()
    if type(made) is Tensor and not torch.compiler.is_compiling() and not torch.compiler.is_exporting():
        _MADE[key] = made
    return made


def on_gpu(tensor: Tensor) -> bool:
    """Tells whether routines that wait for the device, or cannot be captured into a graph, are to be avoided."""
    return tensor.device.type in GPUS


def inverse_of(matrix: Tensor, ridge: float = 0) -> tuple[Tensor, Tensor]:
    """The inverse of a symmetric M, N x N, and log det M, in few launches and without a look at the numbers.

    Up to :data:`LARGEST` rows of M and of the identity are eliminated one after the other; larger ones are factored.

    Args:
        matrix: M, ``[*B, N, N]``, with both triangles.
        ridge: is added to the diagonal.

    Returns:
        M⁻¹, ``[*B, N, N]``, and log det M, ``[*B, 1]``. NaN where M is not positive definite.

    Examples:
        >>> inverse, log_det = inverse_of(torch.tensor([[2.0, 1.0], [1.0, 1.0]]))
        >>> inverse.round(decimals=4), log_det.abs() < 1e-6
        (tensor([[ 1., -1.],
                [-1.,  2.]]), tensor([True]))
    """
    size = matrix.shape[-1]
    identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device).expand_as(matrix)
    matrix = torch.add(matrix, identity, alpha=ridge) if ridge else matrix
    if not 0 < size <= LARGEST:
        factor, info = torch.linalg.cholesky_ex(matrix)
        factor = torch.where((info == 0)[..., None, None], factor, torch.nan)
        root = torch.linalg.solve_triangular(factor, identity, upper=False)
        return root.mT @ root, 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)
    rest, rows, pivots = torch.cat([matrix, identity], -1), [], []
    for _ in range(size):  # what is left of the table has one row and one column less each time
        pivots.append(torch.threshold(rest[..., :1, :1], 0, torch.nan))
        rows.append(rest[..., :1, 1:] * pivots[-1].rsqrt())
        if rest.shape[-2] > 1:
            column = rows[-1][..., : rest.shape[-2] - 1]
            rest = torch.addcmul(rest[..., 1:, 1:], column.mT, rows[-1], value=-1)
    root = torch.cat([row[..., -size:] for row in rows], -2)  # L⁻¹
    return root.mT @ root, torch.cat(pivots, -2).log().sum(-2)


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
    lower = _factor(gram, ridge=1)
    solved = _solve(lower, _rows(cross))
    increment = _sum(shift[..., i, None] * value.unsqueeze(-2) for i, value in enumerate(solved))
    square = _squared_norm(_forward(lower, _entries(mean_shift.squeeze(-2))))
    return increment, square, _log_det(lower)


def gain_written_out(matrix: Tensor, cross: Tensor, residual: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The gain of a symmetric M, O x O, and what its likelihood needs, without a call of LAPACK.

    Args:
        matrix: M, ``[*B, O, O]`` with O of 1 to 4; its lower triangle is read.
        cross: C, ``[*B, O, S]``.
        residual: r, ``[*B, O]``.

    Returns:
        Cᵀ M⁻¹, ``[*B, S, O]``; rᵀ M⁻¹ r and log det M, ``[*B, 1]`` each. NaN where M is not positive definite.

    Examples:
        >>> one = torch.ones(1, 1)
        >>> gain, square, log_det = gain_written_out(4 * one, 2 * one, 2 * one[0])
        >>> gain.item(), square.item(), log_det.exp().item()
        (0.5, 1.0, 4.0)
    """
    lower = _factor(matrix)
    gain = torch.stack(_solve(lower, _rows(cross)), -1)
    return gain, _squared_norm(_forward(lower, _entries(residual))), _log_det(lower)


def cholesky_written_out(matrix: Tensor) -> Tensor:
    """The lower Cholesky factor of a symmetric N x N matrix, all NaN where there is none; N of 1 to 6.

    Examples:
        >>> cholesky_written_out(torch.tensor([[[4.0]], [[-1.0]]])).flatten()
        tensor([2., nan])
    """
    lower = _factor(matrix)
    last = lower[-1][-1]  # NaN where any pivot is not positive
    zero = torch.where(last > 0, torch.zeros_like(last), last)
    rows = [torch.cat([*row, *[zero] * (len(lower) - len(row))], -1) for row in lower]
    factor = torch.stack(rows, -2)
    return torch.where((last > 0).unsqueeze(-1), factor, torch.nan)


def cholesky_solve_written_out(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve M X = Y with a symmetric M, N x N with N of 1 to 6; NaN where M is not positive definite.

    Args:
        matrix: M, ``[*B, N, N]``; its lower triangle is read.
        right: Y, ``[*B, N, K]``.

    Returns:
        X, ``[*B, N, K]``.

    Examples:
        >>> cholesky_solve_written_out(torch.tensor([[2.0, 0.0], [1.0, 1.0]]), torch.tensor([[1.0], [0.0]])).mT
        tensor([[ 1., -1.]])
    """
    return torch.stack(_solve(_factor(matrix), _rows(right)), -2)


def forward_written_out(matrix: Tensor, right: Tensor) -> Tensor:
    """Solve L X = Y with the Cholesky factor L of a symmetric M, N x N with N of 1 to 6.

    Args:
        matrix: M, ``[*B, N, N]``; its lower triangle is read.
        right: Y, ``[*B, N, K]``.

    Returns:
        X, ``[*B, N, K]``; NaN where M is not positive definite.

    Examples:
        >>> forward_written_out(torch.tensor([[4.0, 0.0], [2.0, 2.0]]), torch.tensor([[2.0], [0.0]])).mT
        tensor([[ 1., -1.]])
    """
    return torch.stack(_forward(_factor(matrix), _rows(right)), -2)


def _rows(matrix: Tensor) -> Sequence[Tensor]:
    return matrix.unbind(-2)


def _entries(vector: Tensor) -> Sequence[Tensor]:
    return vector.split(1, -1)


def _factor(matrix: Tensor, ridge: float = 0) -> list[list[Tensor]]:
    """L of the matrix and ``ridge`` on its diagonal; each element ``[*B, 1]``, NaN from a pivot on that has no root."""
    lower: list[list[Tensor]] = []
    for i in range(matrix.shape[-1]):
        row: list[Tensor] = []
        for j in range(i + 1):
            rest = matrix[..., i, j, None]
            for k in range(j):
                rest = rest - row[k] * (lower[j][k] if j < i else row[k])
            if j < i:
                row.append(rest / lower[j][j])
            else:
                pivot = rest + ridge if ridge else rest
                row.append(torch.where(pivot > 0, pivot, torch.nan).sqrt())
        lower.append(row)
    return lower


def _forward(lower: list[list[Tensor]], values: Sequence[Tensor]) -> list[Tensor]:
    """L⁻¹ times rows ``[*B, ...]``."""
    solved: list[Tensor] = []
    for i, rest in enumerate(values):
        for k in range(i):
            rest = rest - lower[i][k] * solved[k]
        solved.append(rest / lower[i][i])
    return solved


def _solve(lower: list[list[Tensor]], values: Sequence[Tensor]) -> list[Tensor]:
    """(L Lᵀ)⁻¹ times rows."""
    solved = _forward(lower, values)
    for i in reversed(range(len(solved))):  # with the transpose of L, in place
        for k in range(i + 1, len(solved)):
            solved[i] = solved[i] - lower[k][i] * solved[k]
        solved[i] = solved[i] / lower[i][i]
    return solved


def _squared_norm(entries: Sequence[Tensor]) -> Tensor:
    return _sum(value.square() for value in entries)


def _log_det(lower: list[list[Tensor]]) -> Tensor:
    return 2 * _sum(row[-1].log() for row in lower)


def _sum(values: Iterable[Tensor]) -> Tensor:
    first, *others = values
    return sum(others, first)
