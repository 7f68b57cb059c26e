"""Oracles: the defining equations of the matrix functions, and finite differences."""

import pytest
import torch

from tests.functional.checks import assert_compiled_is_eager
from torch_denkf.functional.linalg import (
    as_covariance,
    cholesky,
    inverse_square_root,
    inverse_square_root_difference,
    is_covariance,
    semidefinite_root,
)

# Eigenvalues with repetitions, zeros, and eight decades between them.
SPECTRA = [[0.0, 0.0, 0.0, 0.0], [2.0, 2.0, 0.0, 0.0], [1e6, 1.0, 1.0, 1e-2], [3.0, 2.0, 1.0, 0.5]]


def matrix_with(spectrum):
    generator = torch.Generator().manual_seed(0)
    orthogonal = torch.linalg.qr(torch.randn(4, 4, generator=generator, dtype=torch.float64)).Q
    return orthogonal @ torch.diag(torch.tensor(spectrum, dtype=torch.float64)) @ orthogonal.T


@pytest.mark.parametrize("spectrum", SPECTRA)
def test_matrix_functions_satisfy_their_definitions(spectrum):
    matrix, identity = matrix_with(spectrum), torch.eye(4, dtype=torch.float64)
    root, difference = inverse_square_root(matrix), inverse_square_root_difference(matrix)
    # Round-off 1e-16 times the norm of the matrix, 1e6 at most.
    torch.testing.assert_close(root @ (identity + matrix) @ root, identity, rtol=0, atol=1e-9)
    torch.testing.assert_close(identity + matrix @ difference, root, rtol=0, atol=1e-9)
    assert torch.linalg.eigvalsh(root).min() > 0  # the positive root, there is only one
    torch.testing.assert_close(root, root.mT)


@pytest.mark.parametrize("function", [inverse_square_root, inverse_square_root_difference])
@pytest.mark.parametrize("spectrum", [[4.0, 4.0, 4.0, 4.0], [2.0, 2.0, 1.0, 1.0], [3.0, 2.0, 1.0, 0.5]])
def test_gradients_equal_finite_differences_at_repeated_eigenvalues(function, spectrum):
    matrix = torch.stack([matrix_with(spectrum), matrix_with(SPECTRA[3])]).requires_grad_()
    assert torch.autograd.gradcheck(lambda m: function((m + m.mT) / 2), matrix)


def test_cholesky_fails_loudly_and_only_where_it_fails():
    good = matrix_with(SPECTRA[3])
    factor = cholesky(torch.stack([good, -good]))
    assert torch.equal(factor[0], torch.linalg.cholesky(good))
    assert factor[1].isnan().all()


# The ridge of a root is relative, and 1e-14 times the dimension: its root is 1e-7.


def test_root_of_a_definite_matrix_is_its_cholesky_factor(float64):
    factor = torch.randn(5, 3, 3).tril()
    factor.diagonal(dim1=1, dim2=2).abs_().add_(0.5)
    units = torch.tensor([1e6, 1.0, 1e-6])  # metres and microradians alike
    factor = units.unsqueeze(-1) * factor
    root = semidefinite_root(factor @ factor.mT)
    torch.testing.assert_close(root / units.unsqueeze(-1), factor / units.unsqueeze(-1), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("rank", [1, 2, 3])
@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
def test_root_is_a_root_whatever_the_rank(float64, rank, batch):
    some = torch.randn(*batch, 3, rank)
    cov = some @ some.mT
    root = semidefinite_root(cov)
    assert (root.triu(1) == 0).all()
    torch.testing.assert_close(root @ root.mT, cov, rtol=1e-12, atol=1e-12)


def test_root_fails_loudly_and_only_where_it_fails(float64):
    cov = torch.stack([torch.eye(2), torch.tensor([[1.0, 2.0], [2.0, 1.0]]), torch.zeros(2, 2)])
    root = semidefinite_root(cov)
    assert root[1].isnan().any()
    torch.testing.assert_close(root[[0, 2]], cov[[0, 2]], rtol=1e-13, atol=0)


def test_gradient_of_a_root_is_that_of_a_root(float64):
    # A A^T = P: the derivative of the left-hand side in any direction is that direction, up to the ridge.
    some, direction = torch.randn(3, 3), torch.randn(3, 3)
    direction = direction + direction.mT
    square = lambda cov: semidefinite_root(cov) @ semidefinite_root(cov).mT  # noqa: E731
    _, moved = torch.autograd.functional.jvp(square, some @ some.mT, direction)
    torch.testing.assert_close(moved, direction, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("size", [1, 2, 3, 8])
def test_covariance_check_uses_correlations(float64, size):
    """Oracle: eigenvalues of the correlations; units that differ by 1e6 do not matter."""
    torch.manual_seed(0)
    root = torch.randn(200, size, size)
    units = 10 ** (6 * torch.rand(200, size) - 3)
    shift = torch.linspace(-0.5, 0.5, 200)[:, None, None] * torch.eye(size)
    cov = units.unsqueeze(-1) * (root @ root.mT / size + shift) * units.unsqueeze(-2)
    variance = cov.diagonal(dim1=-2, dim2=-1)
    scale = variance.abs().rsqrt()
    least = torch.linalg.eigvalsh(scale.unsqueeze(-1) * cov * scale.unsqueeze(-2))[:, 0]
    expected = (least > 0) & (variance > 0).all(-1)
    assert 20 < expected.sum() < 190 or size == 1
    assert is_covariance(cov).equal(expected)
    if size == 3:
        assert_compiled_is_eager(is_covariance, cov)


def test_invalid_covariance_gives_nan_in_its_row_only():
    one = torch.tensor([[1.0, 0.5], [0.5, 1.0]])
    wrong = [
        [[1.0, 0.5], [0.4, 1.0]],
        [[1.0, 2.0], [2.0, 1.0]],
        [[1.0, 0.9, -0.9], [0.9, 1.0, 0.9], [-0.9, 0.9, 1.0]],
        [[0.0, 0.1], [0.1, 1.0]],
        [[-1.0, 0.0], [0.0, 1.0]],
        [[torch.nan, 0.0], [0.0, 1.0]],
        [[torch.inf, 0.0], [0.0, 1.0]],
    ]
    for each in map(torch.tensor, wrong):
        sound = one if len(each) == 2 else torch.eye(3)
        both = as_covariance(torch.stack([sound, each]), torch.zeros(2, len(each)))
        assert both[0].equal(sound)
        assert both[1].isnan().all()
    zero = torch.zeros(2, 2)
    assert as_covariance(zero, torch.zeros(2)).equal(zero)
    singular = torch.ones(2, 2).requires_grad_()
    out = as_covariance(singular, torch.zeros(2))
    assert out.equal(torch.ones(2, 2))
    assert torch.autograd.grad(out.sum(), singular)[0].equal(torch.ones(2, 2))
    variances = as_covariance(torch.tensor([[4.0, 0.0], [-1.0, 2.0]]), torch.zeros(2, 2))
    assert variances[0].equal(torch.diag(torch.tensor([4.0, 0.0])))
    assert variances[1].diagonal().isnan().tolist() == [True, False]
