"""Functions of matrices that are safe to differentiate; the result is NaN if a matrix has none."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torch_denkf.functional.kernels.resolvents import sum_of_resolvents
from torch_denkf.functional.kernels.small_system import (
    LARGEST_ELIMINATED,
    LARGEST_FACTOR,
    WrittenOut,
    inverse_of,
    is_written_out,
    on_gpu,
)


def cholesky(matrix: Tensor) -> Tensor:
    """Returns the lower Cholesky factor L of a symmetric positive definite matrix, NaN if there is none.

    ``torch.linalg.cholesky`` raises and so waits for the device; ``torch.linalg.cholesky_ex`` returns a
    half-finished factor. Here, only the failed matrices of the batch become NaN.

    Args:
        matrix: ``[*B, N, N]``; only its lower triangle is read.

    Returns:
        L with ``L @ L.mT == matrix``, ``[*B, N, N]``.

    Raises:
        RuntimeError: (from torch) if the matrix is not square.

    Examples:
        >>> import torch
        >>> cholesky(torch.tensor([[[4.0]], [[-1.0]]])).flatten()
        tensor([2., nan])
    """
    if is_written_out(matrix, LARGEST_FACTOR):
        return WrittenOut(matrix).factor()
    factor, info = torch.linalg.cholesky_ex(matrix)
    return factor.masked_fill((info != 0)[..., None, None], torch.nan)


def semidefinite_root(cov: Tensor) -> Tensor:
    """Returns a root A of a covariance P, A Aᵀ = P; P may be singular.

    It is the Cholesky factor of the correlations times the standard deviations. The correlations have a ridge, which
    is relative, so that the units of the components do not matter, and covers negative eigenvalues of a Gram matrix
    due to round-off. The scaling is a constant to the gradient: any scaling gives a root of the same matrix.

    Args:
        cov: P, ``[*B, N, N]``, symmetric positive semi-definite.

    Returns:
        A, lower triangular, ``[*B, N, N]``; NaN if P is not positive semi-definite.

    Examples:
        >>> import torch
        >>> semidefinite_root(torch.tensor([[4.0, 0.0], [0.0, 0.0]]))
        tensor([[2., 0.],
                [0., 0.]])
    """
    correlation, std, _ = _correlation(cov)
    return std.unsqueeze(-1) * cholesky(correlation)


def whitened(rows: Tensor, cov: Tensor) -> Tensor:
    """Multiplies rows ``[*B, E, N]`` by the inverse Cholesky factor of their covariance; constant components give 0."""
    correlation, _, inverse = _correlation(cov)
    scaled = (rows * inverse.unsqueeze(-2)).mT
    if is_written_out(correlation, LARGEST_FACTOR):
        return WrittenOut(correlation).forward(scaled).mT
    return torch.linalg.solve_triangular(cholesky(correlation), scaled, upper=False).mT


def semidefinite_solve(cov: Tensor, right: Tensor, *, spare: float = 0) -> Tensor:
    """Solves P X = Y for a covariance P; if P is singular, X is one of the solutions.

    The system is solved in correlations with a relative ridge, see :func:`semidefinite_root`. Components of zero
    variance get zero; their row of ``right`` should be zero.

    Args:
        cov: P, ``[*B, N, N]``, symmetric positive semi-definite.
        right: Y, ``[*B, N, M]``.
        spare: number added to the diagonal of correlations that are not positive semi-definite, up to rounding.

    Returns:
        X, ``[*B, N, M]``; NaN if P is not positive semi-definite.

    Examples:
        >>> import torch
        >>> semidefinite_solve(torch.tensor([[4.0, 0.0], [0.0, 0.0]]), torch.tensor([[2.0], [0.0]]))
        tensor([[0.5000],
                [0.0000]])
    """
    correlation, _, inverse = _correlation(cov)
    if spare:
        failed = cholesky(correlation.detach())[..., -1, -1].isnan()
        correlation = correlation + (spare * failed.unsqueeze(-1).expand_as(inverse)).diag_embed()
    return inverse.unsqueeze(-1) * solve(correlation, inverse.unsqueeze(-1) * right)


def solve(matrix: Tensor, right: Tensor) -> Tensor:
    """Solves M X = Y for a symmetric positive definite M; NaN if M is not.

    Args:
        matrix: M, ``[*B, N, N]``.
        right: Y, ``[*B, N, K]``.

    Returns:
        X, ``[*B, N, K]``.

    Examples:
        >>> solve(torch.tensor([[2.0, 1.0], [1.0, 1.0]]), torch.tensor([[1.0], [0.0]])).mT.round(decimals=4)
        tensor([[ 1., -1.]])
    """
    return (WrittenOut if is_written_out(matrix, LARGEST_FACTOR) else Solver)(matrix).solve(right)


class Solver:
    """Solves several systems of one symmetric positive definite matrix; NaN if it is not.

    On a processor it solves with the Cholesky factor. On a GPU, and for compilers up to :data:`LARGEST_ELIMINATED`
    unknowns, it multiplies by the inverse: torch solves batches with MAGMA there, which cannot be captured into a CUDA
    graph, and the backward pass of the inverse has only products.

    Args:
        matrix: M, ``[*B, N, N]``.
        ridge: number added to the diagonal.
    """

    def __init__(self, matrix: Tensor, ridge: float = 0):
        self.direct = on_gpu(matrix) or is_written_out(matrix, LARGEST_ELIMINATED)
        if self.direct:
            found: tuple[Tensor, Tensor] = (_Inverse.apply if _differentiated() else inverse_of)(matrix, ridge)
            self.inverse, self.log = found
            return
        if ridge:
            matrix = matrix + ridge * torch.eye(matrix.shape[-1], dtype=matrix.dtype, device=matrix.device)
        self.factor = cholesky(matrix)

    def solve(self, right: Tensor) -> Tensor:
        """Returns M⁻¹ Y, ``[*B, N, K]``."""
        return self.inverse @ right if self.direct else torch.cholesky_solve(right, self.factor)

    def between(self, left: Tensor, right: Tensor) -> Tensor:
        """Returns D M⁻¹ Y, ``[*B, E, K]``, for D ``[*B, E, N]``."""
        return left @ self.solve(right)

    def square(self, vector: Tensor) -> Tensor:
        """Returns rᵀ M⁻¹ r, ``[*B, 1]``, for r ``[*B, N, 1]``."""
        if self.direct:
            return (vector.mT @ (self.inverse @ vector)).squeeze(-1)
        return torch.linalg.solve_triangular(self.factor, vector, upper=False).square().sum(-2)

    def log_det(self) -> Tensor:
        """Returns log det M, ``[*B, 1]``."""
        return self.log if self.direct else 2 * self.factor.diagonal(dim1=-2, dim2=-1).log().sum(-1, keepdim=True)


def divide(left: Tensor, matrix: Tensor) -> Tensor:
    """Returns A M⁻¹ for a small regular M that is not symmetric, such as a Jacobian.

    On a GPU it solves the normal equations, since torch computes LU factors with MAGMA there.

    Args:
        left: A, ``[*B, K, N]``.
        matrix: M, ``[*B, N, N]``.

    Examples:
        >>> divide(torch.tensor([[1.0, 0.0]]), torch.tensor([[2.0, 0.0], [1.0, 1.0]]))
        tensor([[0.5000, 0.0000]])
    """
    if on_gpu(matrix):
        return left @ solve(matrix.mT @ matrix, matrix.mT)
    return left @ torch.linalg.inv(matrix)


class _Inverse(torch.autograd.Function):
    """The inverse and log det of :func:`inverse_of`."""

    generate_vmap_rule = True

    @staticmethod
    def forward(matrix: Tensor, ridge: float) -> tuple[Tensor, Tensor]:
        return inverse_of(matrix, ridge)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.save_for_backward(output[0])

    @staticmethod
    def backward(ctx, gradient: Tensor, of_log: Tensor) -> tuple[Tensor, None]:
        (inverse,) = ctx.saved_tensors
        return inverse * of_log.unsqueeze(-1) - inverse @ gradient @ inverse, None


def is_covariance(cov: Tensor) -> Tensor:
    """Tells which matrices are covariances up to rounding: symmetric and positive semi-definite, without NaN.

    Rounding is relative to the variances, so that units do not matter. There is no gradient.

    Args:
        cov: ``[*B, N, N]``.

    Returns:
        Boolean, ``[*B]``.

    Examples:
        >>> import torch
        >>> is_covariance(torch.tensor([[[1.0, 0.5], [0.5, 1.0]], [[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.0, 1.0]]]))
        tensor([ True, False, False])
    """
    cov = cov.detach() if cov.dtype == torch.float64 else cov.detach().float()  # there is no factor in half precision
    variance, rounding = cov.diagonal(dim1=-2, dim2=-1), 100 * cov.shape[-1] * torch.finfo(cov.dtype).eps
    largest = rounding**2 * (variance.unsqueeze(-1) * variance.unsqueeze(-2))
    symmetric = ((cov - cov.mT).square() <= largest).flatten(-2).all(-1)
    # A variance of zero is valid, but not with a non-zero covariance, which the factor's next row divides by it.
    ridge = rounding * variance + torch.finfo(cov.dtype).tiny
    return symmetric & cholesky(cov + ridge.diag_embed())[..., -1, -1].isfinite()


def as_covariance(noise: Tensor, mean: Tensor) -> Tensor:
    """Returns the covariance of a noise given as variances or covariances; NaN if it is invalid.

    Args:
        noise: variances ``[*B, N]``, or covariances ``[*B, N, N]``; a negative variance becomes NaN.
        mean: ``[*B, S]``, to tell them apart by the number of dimensions.

    Returns:
        ``[*B, N, N]``.

    Examples:
        >>> import torch
        >>> as_covariance(torch.tensor([4.0, -1.0]), torch.zeros(2))
        tensor([[4., 0.],
                [0., nan]])
    """
    if noise.ndim == mean.ndim:
        return noise.masked_fill(noise < 0, torch.nan).diag_embed()
    return torch.where(is_covariance(noise)[..., None, None], noise, torch.nan)


def _correlation(cov: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns correlations with a ridge, standard deviations, and their inverses, 0 for a variance of zero."""
    dim = cov.shape[-1]
    variance, ridge = cov.diagonal(dim1=-2, dim2=-1).detach(), 10 * dim * torch.finfo(cov.dtype).eps
    # A negative variance is invalid, unless it is round-off relative to the largest.
    negative = (variance < -ridge * variance.abs().amax(-1, keepdim=True)).any(-1, keepdim=True)
    std = torch.where(negative, torch.nan, variance.clamp(min=0).sqrt())
    empty = std == 0
    inverse = std.masked_fill(empty, torch.inf).reciprocal()
    diagonal = (empty.to(std) + ridge).diag_embed()
    correlation = (cov * inverse.unsqueeze(-1) * inverse.unsqueeze(-2) + diagonal) / (1 + ridge)
    return correlation, std, inverse


def inverse_square_root(matrix: Tensor) -> Tensor:
    """Returns (I + M)^-1/2 of a symmetric positive semi-definite M, differentiable at repeated eigenvalues.

    The symmetric square root is the one that moves the members least (Ott et al. 2004; Hunt et al. 2007).

    Args:
        matrix: M, ``[*B, N, N]``; eigenvalues that are negative by round-off count as zero.
            A matrix with a NaN gives NaN.

    Returns:
        (I + M)^-1/2, symmetric, ``[*B, N, N]``.

    Raises:
        RuntimeError: (from torch) if the matrix is not square.

    Examples:
        >>> import torch
        >>> inverse_square_root(torch.tensor([[3.0, 0.0], [0.0, 8.0]]))
        tensor([[0.5000, 0.0000],
                [0.0000, 0.3333]])
    """
    return _symmetric_function(matrix, difference=False)


def inverse_square_root_difference(matrix: Tensor) -> Tensor:
    """Returns g(M) = M⁻¹ ((I + M)^-1/2 − I), also for singular M, differentiable at repeated eigenvalues.

    With M = YᵀY it gives the symmetric square root of the larger system from the smaller one:
    (I + YYᵀ)^-1/2 = I + Y g(YᵀY) Yᵀ. It is computed as −1/(r (1 + r)) with r = sqrt(1 + m), which never
    divides by m.

    Args:
        matrix: M, symmetric positive semi-definite, ``[*B, N, N]``.

    Returns:
        g(M), symmetric, ``[*B, N, N]``; −1/2 I at M = 0.

    Raises:
        RuntimeError: (from torch) if the matrix is not square.

    Examples:
        >>> import torch
        >>> inverse_square_root_difference(torch.tensor([[3.0, 0.0], [0.0, 0.0]]))
        tensor([[-0.1667,  0.0000],
                [ 0.0000, -0.5000]])
    """
    return _symmetric_function(matrix, difference=True)


def _differentiated() -> bool:
    # Function.apply looks up the argument names at each call, which takes longer than a small matrix does.
    return torch.is_grad_enabled() or torch.compiler.is_compiling()


def _symmetric_function(matrix: Tensor, *, difference: bool) -> Tensor:
    if on_gpu(matrix):
        return sum_of_resolvents(matrix, difference=difference)
    if _differentiated():
        return _SymmetricFunction.apply(matrix, difference)[0]
    return _SymmetricFunction.forward(matrix, difference)[0]


class _SymmetricFunction(torch.autograd.Function):
    """Computes V f(Λ) Vᵀ; the backward pass is V (Γ ∘ (Vᵀ Ḡ V)) Vᵀ with Γ the divided differences of f.

    This is the theorem of Daleckii and Krein (Higham 2008, Functions of Matrices, Theorem 3.11). The backward pass of
    eigh divides by differences of eigenvalues and is NaN if two agree; written out for these two functions, with
    r = sqrt(1 + λ), Γ divides only by numbers >= 1.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(matrix: Tensor, difference: bool) -> tuple[Tensor, Tensor, Tensor]:
        # eigh raises on the first NaN; here only the matrices with a NaN become NaN.
        finite = matrix.isfinite().all(-1).all(-1)
        eigenvalues, vectors = torch.linalg.eigh(torch.where(finite[..., None, None], matrix, 0))
        root = torch.where(finite[..., None], (1 + eigenvalues.clamp(min=0)).sqrt(), torch.nan)
        values = -1 / (root * (1 + root)) if difference else 1 / root
        return (vectors * values.unsqueeze(-2)) @ vectors.mT, root, vectors

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.difference = inputs[1]
        ctx.mark_non_differentiable(*output[1:])
        ctx.save_for_backward(*output[1:])

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor, *_: Tensor):
        root, vectors = ctx.saved_tensors
        row, column = root.unsqueeze(-1), root.unsqueeze(-2)
        divided = -1 / (row * column * (row + column))
        if ctx.difference:
            divided = -divided * (1 + row + column) / ((1 + row) * (1 + column))
        gradient = (gradient + gradient.mT) / 2
        return vectors @ (divided * (vectors.mT @ gradient @ vectors)) @ vectors.mT, None


def product_of_known(matrix: Tensor, vector: Tensor) -> Tensor:
    """Returns H x; NaN in x affects only rows with a coefficient for it.

    Args:
        matrix: H, ``[O, S]``.
        vector: x, ``[*B, S]``.

    Returns:
        H x, ``[*B, O]``.

    Examples:
        >>> import torch
        >>> product_of_known(torch.tensor([[2.0, 0.0], [1.0, 1.0]]), torch.tensor([3.0, torch.nan]))
        tensor([6., nan])
    """
    unknown = vector.isnan()
    reached = unknown.to(matrix.dtype) @ (matrix != 0).to(matrix.dtype).mT > 0
    return torch.where(reached, torch.nan, torch.where(unknown, 0, vector) @ matrix.mT)
