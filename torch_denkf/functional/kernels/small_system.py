"""Cholesky factors and solutions of small systems, element by element, which compilers can fuse with other code.

In a compiled step LAPACK's calls for a 2 x 2 system cost more than its arithmetic: they cannot be fused, each has an
overhead, and in C++ (a filter's ``compile()`` on a processor, a package of AOTInductor) some take a slow fallback.
In eager mode on a processor LAPACK is faster. On a GPU, torch's routines for batches of systems synchronise with the
device, or cannot be captured into a CUDA graph, as MAGMA's: :func:`inverse_of` replaces them there.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from contextlib import suppress

import torch
from torch import Tensor

#: The largest O of systems that are written out; the number of operations grows with its cube.
LARGEST = 4
#: The largest matrix for which only the factor is written out, such as a state's covariance.
LARGEST_FACTOR = 6
#: The largest system that is solved by elimination, row by row, under a compiler.
LARGEST_ELIMINATED = 12
#: Devices on which each call is a kernel launch, and reading a value waits for all launches before it.
GPUS = ("cuda",)


_MADE: dict[Hashable, Tensor] = {}


def made_once(key: Hashable, make: Callable[[], Tensor]) -> Tensor:
    """Returns a constant tensor, created in the first call, so that no later graph captures a copy to the device.

    A tensor without values, as compilers trace with, is not cached.

    Args:
        key: key of the constant, which includes its device.
        make: creates the constant.
    """
    if key in _MADE:
        return _MADE[key]
    made = make()
    if type(made) is Tensor and not torch.compiler.is_compiling() and not torch.compiler.is_exporting():
        with suppress(NotImplementedError, RuntimeError), torch.inference_mode(False):
            made.untyped_storage()  # torch.func's wrappers, valid in one call only, have none
            _MADE[key] = made = made.clone()  # tensors of inference mode cannot be used with gradients
    return made


def on_gpu(tensor: Tensor) -> bool:
    """Tells whether to avoid routines that wait for the device, or cannot be captured into a graph."""
    return tensor.device.type in GPUS


def identity_of(matrix: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Returns the identity ``[N, N]`` for matrices ``[*B, N, N]``; it is shared, so do not write to it."""
    size, dtype, device = matrix.shape[-1], dtype or matrix.dtype, matrix.device
    return made_once(("identity", size, dtype, device), lambda: torch.eye(size, dtype=dtype, device=device))


def inverse_of(matrix: Tensor, ridge: float = 0) -> tuple[Tensor, Tensor]:
    """Returns the inverse of a symmetric M, N x N, and log det M, in few launches and without reading values.

    Up to :data:`LARGEST` rows, and under a compiler up to :data:`LARGEST_ELIMINATED`, are eliminated one after the
    other; larger matrices are factored.

    Args:
        matrix: M, ``[*B, N, N]``, with both triangles.
        ridge: number added to the diagonal.

    Returns:
        M⁻¹, ``[*B, N, N]``, and log det M, ``[*B, 1]``. NaN if M is not positive definite.

    Examples:
        >>> inverse, log_det = inverse_of(torch.tensor([[2.0, 1.0], [1.0, 1.0]]))
        >>> inverse.round(decimals=4), log_det.abs() < 1e-6
        (tensor([[ 1., -1.],
                [-1.,  2.]]), tensor([True]))
    """
    size = matrix.shape[-1]
    identity = identity_of(matrix).expand_as(matrix)
    matrix = torch.add(matrix, identity, alpha=ridge) if ridge else matrix
    if not 0 < size <= (LARGEST_ELIMINATED if torch.compiler.is_compiling() else LARGEST):
        factor, info = torch.linalg.cholesky_ex(matrix)
        factor = torch.where((info == 0)[..., None, None], factor, torch.nan)
        root = torch.linalg.solve_triangular(factor, identity, upper=False)
        return root.mT @ root, 2 * factor.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)
    rest, rows, pivots = torch.cat([matrix, identity], -1), [], []
    for _ in range(size):  # the remaining table has one row and one column less each time
        pivots.append(torch.threshold(rest[..., :1, :1], 0, torch.nan))
        rows.append(rest[..., :1, 1:] * pivots[-1].rsqrt())
        if rest.shape[-2] > 1:
            column = rows[-1][..., : rest.shape[-2] - 1]
            rest = torch.addcmul(rest[..., 1:, 1:], column.mT, rows[-1], value=-1)
    root = torch.cat([row[..., -size:] for row in rows], -2)  # L⁻¹
    return root.mT @ root, torch.cat(pivots, -2).log().sum(-2)


def is_written_out(matrix: Tensor, largest: int = LARGEST) -> bool:
    """Tells whether a system of one to ``largest`` unknowns is to be written out: only under a compiler."""
    return torch.compiler.is_compiling() and 0 < matrix.shape[-1] <= largest


class WrittenOut:
    """The Cholesky factor L of a symmetric matrix M, N x N, element by element, without LAPACK.

    All results are NaN if M is not positive definite.

    Args:
        matrix: M, ``[*B, N, N]``; its lower triangle is read.
        ridge: number added to the diagonal.

    Examples:
        >>> system = WrittenOut(torch.tensor([[4.0, 0.0], [2.0, 2.0]]))
        >>> system.factor()
        tensor([[2., 0.],
                [1., 1.]])
        >>> right = torch.tensor([[2.0], [0.0]])
        >>> system.forward(right).mT, system.solve(right).mT, system.square(right), system.log_det().exp()
        (tensor([[ 1., -1.]]), tensor([[ 1., -1.]]), tensor([2.]), tensor([4.]))
    """

    def __init__(self, matrix: Tensor, ridge: float = 0):
        lower: list[list[Tensor]] = []
        for i in range(matrix.shape[-1]):  # each element is [*B, 1], NaN after a pivot that is not positive
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
        self.lower = lower

    def factor(self) -> Tensor:
        """Returns L, ``[*B, N, N]``, all NaN if M is not positive definite."""
        last = self.lower[-1][-1]  # NaN where any pivot is not positive
        zero = torch.where(last > 0, torch.zeros_like(last), last)
        rows = [torch.cat([*row, *[zero] * (len(self.lower) - len(row))], -1) for row in self.lower]
        return torch.where((last > 0).unsqueeze(-1), torch.stack(rows, -2), torch.nan)

    def forward(self, right: Tensor) -> Tensor:
        """Returns L⁻¹ Y, ``[*B, N, K]``."""
        return torch.stack(self._forward(right), -2)

    def solve(self, right: Tensor) -> Tensor:
        """Returns M⁻¹ Y, ``[*B, N, K]``."""
        return torch.stack(self._solve(right), -2)

    def between(self, left: Tensor, right: Tensor) -> Tensor:
        """Returns D M⁻¹ Y, ``[*B, E, K]``, for D ``[*B, E, N]``, without a product of matrices."""
        return _sum([left[..., i, None] * value.unsqueeze(-2) for i, value in enumerate(self._solve(right))])

    def square(self, vector: Tensor) -> Tensor:
        """Returns rᵀ M⁻¹ r, ``[*B, 1]``, for r ``[*B, N, 1]``."""
        return _sum([value.square() for value in self._forward(vector)])

    def log_det(self) -> Tensor:
        """Returns log det M, ``[*B, 1]``."""
        return 2 * _sum([row[-1].log() for row in self.lower])

    def _forward(self, right: Tensor) -> list[Tensor]:
        solved: list[Tensor] = []
        for i, rest in enumerate(right.unbind(-2)):
            for k in range(i):
                rest = rest - self.lower[i][k] * solved[k]
            solved.append(rest / self.lower[i][i])
        return solved

    def _solve(self, right: Tensor) -> list[Tensor]:
        solved = self._forward(right)
        for i in reversed(range(len(solved))):  # with the transpose of L
            for k in range(i + 1, len(solved)):
                solved[i] = solved[i] - self.lower[k][i] * solved[k]
            solved[i] = solved[i] / self.lower[i][i]
        return solved


def _sum(values: list[Tensor]) -> Tensor:
    return sum(values[1:], values[0])
