"""The forms that a GPU takes instead of LAPACK's, run on a processor: they agree with LAPACK, and call none of it."""

import pytest
import torch

from torch_denkf.functional import _ensemble_space, analyse
from torch_denkf.functional.gaussian import solve_for_gain
from torch_denkf.functional.kernels.small_system import LARGEST, inverse_of
from torch_denkf.functional.linalg import (
    divide,
    inverse_square_root,
    inverse_square_root_difference,
    semidefinite_solve,
    solve,
)


def covariance(size, *batch, rank=None, seed=0):
    rows = torch.randn(*batch, rank or 2 * size, size, generator=torch.Generator().manual_seed(seed)).double()
    return rows.mT @ rows


@pytest.mark.parametrize("size", [1, 2, LARGEST, LARGEST + 1, 9])
def test_inverse_and_its_gradient(float64, as_on_a_gpu, size):
    matrix = covariance(size, 3).requires_grad_()
    inverse, log_det = as_on_a_gpu(inverse_of, matrix)
    torch.testing.assert_close(inverse @ matrix, torch.eye(size).expand(3, -1, -1), rtol=0, atol=1e-9)
    torch.testing.assert_close(log_det, torch.logdet(matrix).unsqueeze(-1))
    right = torch.randn(3, size, 2)
    weight = torch.randn(3, size, 2)
    ours, theirs = (run(solve, matrix, right) for run in (as_on_a_gpu, lambda f, *args: f(*args)))
    torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)

    def gradients(solved):
        out = torch.autograd.grad((solved * weight).sum(), matrix)[0]
        return out + out.mT  # that of a lower triangle, or of both

    torch.testing.assert_close(as_on_a_gpu(gradients, ours), gradients(theirs), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("size", [2, LARGEST + 1])
def test_indefinite_matrices_give_nan_in_their_row_only(as_on_a_gpu, size):
    matrix = torch.stack([torch.eye(size), -torch.eye(size), torch.zeros(size, size), torch.eye(size) * torch.nan])
    for value in as_on_a_gpu(inverse_of, matrix):
        assert value[0].isfinite().all()
        assert value[1:].isnan().flatten(1).any(-1).all()
    _, square, log_det = as_on_a_gpu(solve_for_gain, matrix, torch.eye(size).expand(4, -1, -1), torch.ones(4, size))
    assert square[0] == size
    assert log_det[0] == 0
    assert torch.stack([square[1:], log_det[1:]]).isnan().all()


def test_division_by_a_matrix_that_is_not_symmetric(float64, as_on_a_gpu):
    matrix, left = torch.eye(3) + 0.3 * torch.randn(5, 3, 3), torch.randn(5, 2, 3)
    torch.testing.assert_close(as_on_a_gpu(divide, left, matrix), left @ torch.linalg.inv(matrix), rtol=0, atol=1e-9)


@pytest.mark.parametrize("function", [inverse_square_root, inverse_square_root_difference])
@pytest.mark.parametrize("largest", [0.0, 1e-8, 1.0, 1e3, 1e6])
@pytest.mark.parametrize(("dtype", "error"), [(torch.float64, 6e-15), (torch.float32, 6e-7)])
def test_square_root_without_eigenvalues(as_on_a_gpu, function, largest, dtype, error):
    """The error against eigenvalues in double precision is a few roundings, plus that of the matrix itself."""
    gram = covariance(6, 4, rank=4)  # of four directions
    gram = gram * largest / torch.linalg.matrix_norm(gram, 2)[..., None, None]
    exact = function(gram)
    ours = as_on_a_gpu(function, gram.to(dtype))
    rounding = torch.finfo(dtype).eps * largest
    assert (ours - exact).abs().max() < error + rounding, (ours - exact).abs().max().item()
    assert (function(gram.to(dtype)) - exact).abs().max() < error + rounding  # LAPACK's own


@pytest.mark.parametrize("function", [inverse_square_root, inverse_square_root_difference])
def test_gradient_of_the_square_root(float64, as_on_a_gpu, function):
    matrix, weight = covariance(3, 2).requires_grad_(), torch.randn(2, 3, 3)
    ours = torch.autograd.grad((as_on_a_gpu(function, matrix) * weight).sum(), matrix)[0]
    theirs = torch.autograd.grad((function(matrix) * weight).sum(), matrix)[0]
    torch.testing.assert_close((ours + ours.mT) / 2, theirs, rtol=1e-9, atol=1e-9)


def test_semidefinite_solve_of_a_singular_covariance(float64, as_on_a_gpu):
    cov = torch.zeros(7, 7)
    cov[:5, :5] = covariance(5)
    right = cov @ torch.randn(7, 2)
    torch.testing.assert_close(as_on_a_gpu(semidefinite_solve, cov, right), semidefinite_solve(cov, right))


@pytest.mark.parametrize("scheme", ["sensor", "perturbed", "etkf", "sakov"])
@pytest.mark.parametrize("dim", [2, 6, 20])
def test_analysis(float64, as_on_a_gpu, scheme, dim):
    torch.manual_seed(0)
    x, y, noise = torch.randn(3, 8, 5), torch.randn(3, 8, dim), torch.rand(3, dim) + 0.5
    given = {"observed": torch.rand(3, dim) < 0.7, "scheme": scheme}
    given |= {"perturbation": torch.randn(3, 8, dim)} if scheme == "perturbed" else {}
    args = (x.requires_grad_(), torch.randn(3, 8, dim).requires_grad_(), y, noise)
    ours, theirs = as_on_a_gpu(analyse, *args, **given), analyse(*args, **given)

    def gradients(out):
        return torch.autograd.grad(out.ensemble.square().sum() + out.log_likelihood.sum(), args[:2])

    for mine, other in zip((*ours, *as_on_a_gpu(gradients, ours)), (*theirs, *gradients(theirs)), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-9, atol=1e-9)


def test_a_gpu_takes_no_tiles_of_a_cache(monkeypatch, as_on_a_gpu):
    x = torch.zeros(4, 2 * _ensemble_space.TILE_ELEMENTS)
    assert _ensemble_space.columns_in_a_tile(x) == _ensemble_space.TILE_ELEMENTS // 4
    assert as_on_a_gpu(_ensemble_space.columns_in_a_tile, x) is None
    monkeypatch.setattr(_ensemble_space, "GPU_TILE_ELEMENTS", 2**18)  # where memory asks for it
    assert as_on_a_gpu(_ensemble_space.columns_in_a_tile, x) == 2**16


@pytest.mark.parametrize("size", [2, LARGEST + 1])
@pytest.mark.parametrize("place", [0, -1])
def test_infinite_noise_equals_a_missing_reading(float64, as_on_a_gpu, size, place):
    forecast, noise = torch.randn(3, 16, size + 1, requires_grad=True), torch.ones(3, size)
    noise[:, place] = torch.inf
    given = forecast, 2 * forecast[..., :size], torch.randn(3, 16, size), noise
    ours, theirs = as_on_a_gpu(analyse, *given, scheme="sensor"), analyse(*given, scheme="sensor")
    for value, expected in zip(ours, theirs, strict=True):
        torch.testing.assert_close(value, expected)
    gradients = [
        torch.autograd.grad(found.ensemble.square().sum(), forecast, retain_graph=True)[0] for found in (ours, theirs)
    ]
    assert gradients[0].isfinite().all()
    torch.testing.assert_close(*gradients)
