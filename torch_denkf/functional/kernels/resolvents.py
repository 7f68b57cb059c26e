r"""Inverse square roots of matrices without an eigendecomposition, which would synchronise with a GPU.

The integral :math:`A^{-1/2} = \frac{2}{\pi} \int_0^\infty (t^2 + A)^{-1} dt` by the rule of Hale, Higham & Trefethen
(2008, "Computing A^α, log(A), and related matrix functions by contour integrals", SIAM J. Numer. Anal. 46, method 3):
J nodes give an error of exp(−2π² J / (log κ + 3)) for eigenvalues in [1, κ]. All J systems are solved at once, each is
better conditioned than A, and all weights are positive.
"""

from __future__ import annotations

from math import cosh, exp, pi, sinh, sqrt

import torch
from torch import Tensor

from torch_denkf.functional.kernels.small_system import inverse_of, made_once


def nodes(count: int, ratio: float) -> list[tuple[float, float]]:
    """Returns shifts s and weights w with x^-1/2 ≈ Σ w / (x + s) for x in [1, ratio].

    The nodes are equidistant in the argument of Jacobi's sc of modulus sqrt(1 - 1 / ratio), a quotient of theta
    functions that converges fast in the lower half; the upper half mirrors it.

    Examples:
        >>> round(sum(weight / (100 + shift) for shift, weight in nodes(18, 2.0**23)), 7)
        0.1
    """
    rate = _agm(1, sqrt(1 - 1 / ratio))
    half = pi / 4 * rate / _agm(1, ratio**-0.5)
    nome = exp(-4 * half)
    found = []
    for number in range((count + 1) // 2):
        v = 2 * half * (number + 0.5) / count
        top, rise = (f(v) - n * nome**2 * f(3 * v) + m * nome**6 * f(5 * v) for f, n, m in ((sinh, 1, 1), (cosh, 3, 5)))
        bottom = 1 - 2 * nome * cosh(2 * v) + 2 * nome**4 * cosh(4 * v)
        slope = -4 * nome * sinh(2 * v) + 8 * nome**4 * sinh(4 * v)
        scale = 2 * (nome * ratio) ** 0.25 / bottom
        place, weight = (scale * top) ** 2, 4 * half / (pi * count) * scale * (rise - top * slope / bottom)
        found.append((place, weight))
        if 2 * number + 1 < count:
            found.append((ratio / place, weight * sqrt(ratio) / place))
    return found


def _agm(a: float, b: float) -> float:
    while abs(a - b) > 1e-15 * a:
        a, b = (a + b) / 2, sqrt(a * b)
    return a


def sum_of_resolvents(matrix: Tensor, *, difference: bool) -> Tensor:
    """Computes (I + M)^-1/2, or M⁻¹ ((I + M)^-1/2 − I), of a symmetric positive semi-definite M.

    The latter has the same nodes and the weights −w / (1 + s), without cancellation.

    Args:
        matrix: M, ``[*B, N, N]``; its eigenvalues are exact to rounding up to 1 / eps of its precision.
        difference: whether to compute the latter.

    Returns:
        ``[*B, N, N]``; NaN if I + M is not positive definite.

    Examples:
        >>> sum_of_resolvents(torch.tensor([[3.0, 0.0], [0.0, 8.0]]), difference=False).diagonal().round(decimals=4)
        tensor([0.5000, 0.3333])
    """
    if torch.is_grad_enabled() or torch.compiler.is_compiling():
        return _SumOfResolvents.apply(matrix, difference)[0]
    return _SumOfResolvents.forward(matrix, difference)[0]


def _table(like: Tensor) -> Tensor:
    """Returns shifts, weights, and weights of the difference, ``[3, J]``."""

    def make() -> Tensor:
        count = 22 if like.dtype == torch.float32 else 80  # the difference needs that many near M = 0
        found = [(s, w, -w / (1 + s)) for s, w in nodes(count, 1 / torch.finfo(like.dtype).eps)]
        return torch.tensor(found, dtype=like.dtype, device=like.device).mT.contiguous()

    return made_once(("resolvents", like.device, like.dtype), make)


class _SumOfResolvents(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(matrix: Tensor, difference: bool) -> tuple[Tensor, Tensor]:
        table, size = _table(matrix), matrix.shape[-1]
        identity = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
        shifts = (1 + table[0]).reshape(-1, 1, 1) * identity  # [J, N, N]
        inverses = inverse_of(matrix.unsqueeze(-3) + shifts)[0]  # [*B, J, N, N]
        return _weighted(table[1 + difference], inverses), inverses

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.difference = inputs[1]
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1])

    @staticmethod
    def backward(ctx, gradient: Tensor, _: Tensor):
        (inverses,) = ctx.saved_tensors
        moved = inverses @ gradient.unsqueeze(-3) @ inverses
        return -_weighted(_table(gradient)[1 + ctx.difference], moved), None


def _weighted(weights: Tensor, matrices: Tensor) -> Tensor:
    return (weights @ matrices.flatten(-2)).unflatten(-1, matrices.shape[-2:])
