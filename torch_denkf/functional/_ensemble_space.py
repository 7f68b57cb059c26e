"""The analysis in ensemble space: one E x E system, and for large states two passes over tiles of columns.

A whole state of 10⁶ components and 32 members is 128 MB; the dozen intermediate arrays of that size in a plain formula
cost more time, in fresh pages and cache misses, than the arithmetic. With tiles that fit in the cache only the result
is as large as the ensemble.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torch_denkf.functional._whitened import Whitened, scores, shift, whiten
from torch_denkf.functional.kernels.small_system import on_gpu
from torch_denkf.functional.linalg import Solver, inverse_square_root

#: Elements of an ensemble in one tile: 256 KiB in single precision, several of which fit in a core's own cache.
TILE_ELEMENTS = 2**16
#: The same on a GPU: 1 GiB in single precision; the plain formula has a dozen arrays of the ensemble's size.
GPU_TILE_ELEMENTS = 2**28


def solve_ensemble_space(gram: Tensor, right: Tensor, *, square_root: bool) -> tuple[Tensor, Tensor | None, Tensor]:
    """Solves with I + YYᵀ, E x E.

    YYᵀ maps the vector of ones to zero, and the solution is orthogonal to that vector. So the eigenvalue of the vector
    of ones can be chosen: at the mean of the diagonal, c, the matrix keeps its digits when R is tiny.

    Args:
        gram: YYᵀ, ``[*B, E, E]``; the members' anomalies sum to zero.
        right: Y shiftᵀ, ``[*B, E, E]`` or ``[*B, E, 1]``.
        square_root: whether (I + YYᵀ)^-1/2 is wanted.

    Returns:
        The weights rightᵀ (I + YYᵀ)⁻¹, one row for each column of ``right``; the square root, ``[*B, E, E]``, or
        ``None``; log det (I + YYᵀ), ``[*B, 1]``.

    Examples:
        >>> y = torch.tensor([[-1.0], [1.0]])
        >>> weights, _, log_det = solve_ensemble_space(y @ y.mT, y @ torch.tensor([[3.0]]), square_root=False)
        >>> weights.round(decimals=5), log_det.exp()
        (tensor([[-1.,  1.]]), tensor([3.]))
    """
    size = gram.shape[-1]
    free = gram.detach().diagonal(dim1=-2, dim2=-1).mean(-1, keepdim=True)  # c
    gram = gram + (free / size).unsqueeze(-1)
    solver = Solver(gram, ridge=1)
    log_det = solver.log_det() - free.log1p()
    return solver.solve(right).mT, inverse_square_root(gram) if square_root else None, log_det


def columns_in_a_tile(forecast: Tensor, *others: Tensor | None) -> int | None:
    """Returns how many components :func:`analyse_in_tiles` takes at a time, ``None`` if tiles should not be used.

    Tiles gain nothing if everything fits in two of them, or if gradients are needed, as the graph keeps all
    intermediate results. A compiler would unroll the loop over tiles, and fuses the plain formulas itself. A GPU has
    no such cache: its tiles have :data:`GPU_TILE_ELEMENTS`, to limit memory.
    """
    columns = (GPU_TILE_ELEMENTS if on_gpu(forecast) else TILE_ELEMENTS) // max(forecast[..., 0].numel(), 1)
    widest = max(tensor.shape[-1] for tensor in (forecast, *others) if tensor is not None)
    if columns < 64 or widest < 2 * columns or torch.compiler.is_compiling():
        return None
    if torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in (forecast, *others)):
        return None
    return columns


def analyse_in_tiles(
    forecast: Tensor,
    predicted: Tensor,
    observation: Tensor,
    noise: Tensor,
    *,
    scheme: str,
    columns: int,
    observed: Tensor | None = None,
    perturbation: Tensor | None = None,
    rotation: Tensor | None = None,
    total: Callable[..., list[Tensor]] | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Computes :func:`~torch_denkf.functional.analyse` in ensemble space, without gradients, in little memory.

    Its temporary memory is a few tiles ``[*B, E, columns]``, rows ``[*B, O]`` and matrices ``[*B, E, E]``. Arguments
    and results are those of ``analyse``, checked there.

    With ``total`` the columns are one share of all columns: ``total`` takes sums over these columns as tensors
    ``[*B, ...]``, and returns the sums over all shares.
    """
    samples = observation if observation.ndim == forecast.ndim else observation.unsqueeze(-2)
    mask = None if observed is None else observed.expand(noise.shape)

    def tile(start: int) -> tuple[slice, Tensor | None, Whitened]:
        part = slice(start, start + columns)
        seen = None if mask is None else mask[..., part]
        return part, seen, whiten(predicted[..., part], samples[..., part], noise[..., part], seen)

    size, dim = predicted.shape[-2:]
    batch = forecast.shape[:-2]
    gram = forecast.new_zeros(*batch, size, size)
    right = forecast.new_zeros(*batch, size, 1 if scheme == "etkf" else size)
    innovation = torch.empty_like(noise)
    log_noise = count = forecast.new_zeros(*batch, 1)
    square = forecast.new_zeros(*batch, 1, dtype=torch.double)
    for start in range(0, dim, columns):
        part, seen, reading = tile(start)
        draws = None if perturbation is None else perturbation[..., part]
        gram += reading.normalised @ reading.normalised.mT
        right += reading.normalised @ shift(scheme, reading, seen, draws).mT
        innovation[..., part] = reading.innovation.squeeze(-2)
        log_noise = log_noise + reading.noise.log().sum(-1, keepdim=True)
        count = count + (reading.noise.shape[-1] if seen is None else seen.sum(-1, keepdim=True))
        if total is not None:
            square += reading.mean_shift.double().square().sum(-1)
    if total is not None:
        gram, right, log_noise, count, square = total(gram, right, log_noise, count, square)

    weights, root, log_det = solve_ensemble_space(gram, right, square_root=scheme == "etkf")
    mean_weights = weights.mean(-2, keepdim=True)
    # dᵀ(I + YᵀY)⁻¹d is the minimum over w of |d - Yᵀw|² + |w|²: nothing cancels.
    least = mean_weights.square().sum(-1)
    for start in range(0, 0 if total is not None else dim, columns):
        reading = tile(start)[-1]
        least = least + (reading.mean_shift - mean_weights @ reading.normalised).square().sum(-1)
    if total is not None:  # equal, as a difference, without a second sum over all shares
        explained = mean_weights.double() @ right.double().mean(-1, keepdim=True)
        least = (square - explained.squeeze(-1)).to(forecast.dtype)

    if root is not None and rotation is not None:
        root = rotation @ root
    any_seen = (count > 0).unsqueeze(-1)
    ensemble = torch.empty_like(forecast)
    for start in range(0, forecast.shape[-1], columns):
        state = forecast[..., start : start + columns]
        mean = state.mean(-2, keepdim=True)
        anomalies = state - mean
        moved = state + weights @ anomalies if root is None else mean + (weights + root) @ anomalies
        ensemble[..., start : start + columns] = moved if observed is None else torch.where(any_seen, moved, state)
    return ensemble, innovation, *scores(least, log_det, log_noise, count, size)
